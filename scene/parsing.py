"""The stage `parse`: from depth frames and known objects to a posterior over scene graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Event

import jax
import numpy as np
from numpy.typing import NDArray

from recordings.sensor_profile import UnknownTable
from recordings.types import CameraIntrinsics, DepthNoise, Frame
from scene.config import ParseConfig
from scene.execution import Progress
from scene.hidden.hidden_places import HiddenPlaces, hidden_places
from scene.hidden.pose_priors import PlacedObject, Support
from scene.joint_search import JointStart, search_frames, visible_fractions
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.mcmc.chain_model import carrying
from scene.mcmc.colour_turns import SeenColours, with_drawn_turns
from scene.mcmc.sampling import sample_posterior
from scene.objects.scene_object import SceneObject
from scene.objects.slots import FoundObjects
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import scene_views
from scene.presence.births import is_elsewhere
from scene.presence.inference import presence_in_scene
from scene.presence.posterior import Presence
from scene.refinement import refine_poses
from scene.result import SceneResult
from scene.search.search_result import Initialisation
from scene.summary import Sampled, summarise
from shapes.depth_noise import with_surface_error
from shapes.geometry.poses import matrices_of, poses_of


def parse_scene(
    key: jax.Array,
    frames: Sequence[Frame],
    frame_indices: Sequence[int],
    first_camera_from_camera: NDArray[np.float64],
    intrinsics: CameraIntrinsics,
    noise: DepthNoise,
    objects: Sequence[SceneObject],
    config: ParseConfig,
    progress: Progress | None = None,
    unknown: UnknownTable | None = None,
) -> SceneResult:
    """Parse the scene that the frames show: it is judged by all of them.

    The search's poses are refined, moves tell from there which objects are in sight, and chains sample these.
    Poses are refined once more where moves put an object elsewhere, or leave out one that was found.

    Args:
        key: random key.
        frames: depth frames of a scene at rest, at least one.
        frame_indices: their numbers in the recording.
        first_camera_from_camera: (F, 4, 4) poses relative to the first of them.
        intrinsics: of the camera.
        noise: of the sensor.
        objects: what to look for.
        config: settings.
        progress: told of phases, and of blocks of moves done and in all.
        unknown: how well pixels foretell each other, of the sensor's profile; None learns it from the frames.

    Raises:
        ValueError: the frames show nothing to parse, or the profile does not know such pixels.
    """
    keys = jax.random.split(key, 7)
    support_key, search_key, other_key, hidden_key, presence_key, chain_key, moved_key = keys
    seed = int(jax.random.randint(support_key, (), 0, 2**31 - 1))
    views = _views(frames, first_camera_from_camera, intrinsics, seed, config)
    renderer = ObjectRenderer.of(objects)
    noise = replace(noise, outlier_probability=config.outlier_probability)
    windows = [view.window for view in views]
    if unknown is not None:
        learned = UnknownWeights.of(unknown, windows[0].stride / intrinsics.fx)
    else:
        learned = UnknownWeights.learned([one.depth_m for one in windows], noise)
    tell = progress.phase if progress else _untold
    tell("searching, compiling once")
    joint = search_frames(
        (search_key, other_key), views, first_camera_from_camera, objects, renderer, noise, learned, config
    )
    rng = np.random.default_rng(np.asarray(jax.random.key_data(presence_key)))
    seen_noise = with_surface_error(noise, config.model_error_m)
    sampler = _Sampler(joint, objects, renderer, seen_noise, config)
    hidden, presence, start, sampled = sampler.weigh_and_sample(
        rng, (hidden_key, chain_key, moved_key), progress
    )
    numbers = np.asarray(frame_indices)
    scene = summarise(
        rng, sampled, start, hidden, presence, joint.compared.world_from_camera, objects, numbers, config
    )
    return scene.in_camera(first_camera_from_camera[joint.compared.searched])


def _stand_elsewhere(
    presence: Presence,
    found: NDArray[np.bool_],
    particles: NDArray[np.float64],
    objects: Sequence[SceneObject],
) -> NDArray[np.bool_]:
    """Which objects (N,) moves have where those `found` (N,) have no particle (N, P, 7)."""
    elsewhere = presence.seen.copy()
    for one in np.flatnonzero(found & presence.seen).tolist():
        elsewhere[one] = is_elsewhere(presence.poses[one][None], particles[one], objects[one])[0]
    return elsewhere


def _untold(name: str) -> None:
    """Nobody wants to know."""


@dataclass(frozen=True, eq=False)
class _Sampler:
    """What is known of a scene after the search; attributes as of `parse_scene`.

    Attributes:
        joint: the frames, and the best scene that they show.
        renderer: of the objects.
        noise: of the sensor and the surfaces together.
    """

    joint: JointStart
    objects: Sequence[SceneObject]
    renderer: ObjectRenderer
    noise: DepthNoise
    config: ParseConfig

    def weigh_and_sample(
        self, rng: np.random.Generator, keys: Sequence[jax.Array], progress: Progress | None
    ) -> tuple[HiddenPlaces, Presence, Initialisation, Sampled]:
        """Where objects may be out of sight, which are there, the best scene of these, and its samples.

        Moves seldom change the scene of the search, and leave cores free: its chains run beside them.

        Args:
            rng: random numbers.
            keys: of hidden places, of these chains, and of those of a scene that moves have changed.
            progress: as `parse_scene` takes it.
        """
        hidden_key, chain_key, moved_key = keys
        start, tell, is_told = self.joint.start, progress.phase if progress else _untold, Event()

        def tell_blocks(done: int, total: int) -> None:
            if progress and is_told.is_set():
                progress(done, total)

        tell("refining poses")
        particles = self.refine(rng, start)
        tell("weighing where objects may be out of sight")
        hidden = self.weigh_hidden(hidden_key)
        tell("weighing which objects are there")
        with ThreadPoolExecutor(1) as beside:
            sampling = beside.submit(self.sample, chain_key, start, particles, tell_blocks)
            presence = self.weigh_presence(rng, start, particles, hidden)
            tell("sampling scenes")
            is_told.set()
        moved = _stand_elsewhere(presence, start.found, particles, self.objects)
        if not moved.any() and not (start.found & ~presence.seen).any():
            return hidden, presence, start, sampling.result()
        camera_from_world = np.linalg.inv(self.joint.compared.world_from_camera)
        in_camera = poses_of(camera_from_world @ matrices_of(presence.poses))
        start = start.with_scene(presence.seen, in_camera, moved)
        tell("sampling the scene that moves tell")
        sampled = self.sample(moved_key, start, self.refine(rng, start), progress)
        return hidden, presence, start, sampled

    def refine(self, rng: np.random.Generator, start: Initialisation) -> NDArray[np.float64]:
        """Particles (N, P, 7) of each object's pose, as `refine_poses` draws them."""
        return refine_poses(rng, self.joint.compared, self.objects, self.renderer, start, self.config)

    def sample(
        self,
        key: jax.Array,
        start: Initialisation,
        particles: NDArray[np.float64],
        progress: Callable[[int, int], None] | None,
    ) -> Sampled:
        """Chains over the objects of a scene from particles; colours tell how what is round is turned."""
        chain_key, turn_key = jax.random.split(key)
        compared, found = self.joint.compared, FoundObjects.of(start.found)
        chosen, mine = found.taken(self.objects), start.of_slots(found)
        poses = particles[found.placed]
        with jax.enable_x64(True):
            chains = sample_posterior(chain_key, compared, chosen, mine, poses, self.config, progress)
        nats = np.zeros(len(self.objects))
        if compared.colours is not None:
            seen = SeenColours(
                compared.data,
                compared.colours,
                self.renderer,
                self.objects,
                found.indices,
                mine.poses[found.present],
                self.config.colour_weight,
            )
            nats[found.indices] = seen.log_factors()
            rng = np.random.default_rng(np.asarray(jax.random.key_data(turn_key)))
            turned = with_drawn_turns(rng, seen, compared.world_from_camera, chains.samples)
            chains = replace(chains, samples=turned)
        visible = visible_fractions(self.joint, self.renderer, start.found, particles[:, 0])
        return Sampled(found=found, chains=chains, visible_fraction=visible, colour_nats=nats)

    def weigh_presence(
        self,
        rng: np.random.Generator,
        start: Initialisation,
        particles: NDArray[np.float64],
        hidden: HiddenPlaces,
    ) -> Presence:
        """Which objects are there, by moves from particles."""
        return presence_in_scene(
            rng, self.joint.compared, self.joint.searched, self.objects, start, particles, hidden, self.config
        )

    def weigh_hidden(self, key: jax.Array) -> HiddenPlaces:
        """Where objects may be out of sight beside those that the search found."""
        compared, start = self.joint.compared, self.joint.start
        world_from_camera = compared.world_from_camera
        world_from_box = world_from_camera @ matrices_of(start.poses)
        return hidden_places(
            np.random.default_rng(np.asarray(jax.random.key_data(key))),
            compared.views,
            compared.camera_from_world,
            [
                Support(
                    world_from_support=world_from_camera @ one.camera_from_table,
                    half_size_m=one.half_size_m,
                )
                for one in carrying(compared.data.supports, self.objects, start)
            ],
            self.objects,
            {
                one: PlacedObject(shape=self.objects[one], world_from_box=world_from_box[one])
                for one in np.flatnonzero(start.found).tolist()
            },
            self.noise,
            self.config,
        )


def _views(
    frames: Sequence[Frame],
    first_camera_from_camera: NDArray[np.float64],
    intrinsics: CameraIntrinsics,
    seed: int,
    config: ParseConfig,
) -> list[SceneData]:
    """The frames, with their colours where these are compared."""
    depths_m = [frame.depth_m for frame in frames]
    views = scene_views(depths_m, first_camera_from_camera, intrinsics, seed, config.support, config.region)
    if not config.adds_colour:
        return views
    return [
        replace(view, rgb=frame.rgb, rgb_known=frame.rgb_known)
        for view, frame in zip(views, frames, strict=True)
    ]
