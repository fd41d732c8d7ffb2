"""The stage `parse`: from depth frames and known objects to a posterior over scene graphs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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

    Where moves put an object where chains have not been, or leave out one that chains held, these run again
    over the scene that moves tell.

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
    keys = jax.random.split(key, 6)
    support_key, search_key, chain_key, again_key, hidden_key, presence_key = keys
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
        (search_key, again_key), views, first_camera_from_camera, objects, renderer, noise, learned, config
    )
    rng = np.random.default_rng(np.asarray(jax.random.key_data(presence_key)))
    seen_noise = with_surface_error(noise, config.model_error_m)
    sampler = _Sampler(rng, joint, objects, renderer, seen_noise, config, progress)
    compared, start = joint.compared, joint.start
    sampled = sampler.sampled(chain_key, start)
    tell("weighing where objects may be out of sight")
    hidden = sampler.hidden(hidden_key)
    tell("weighing which objects are there")
    presence = presence_in_scene(
        rng, compared, joint.searched, objects, start, sampled.found, sampled.chains, hidden, config
    )
    moved = _stand_elsewhere(presence, sampled, objects)
    if moved.any() or (start.found & ~presence.seen).any():
        in_camera = poses_of(np.linalg.inv(compared.world_from_camera) @ matrices_of(presence.poses))
        start = start.with_scene(presence.seen, in_camera, moved)
        tell("sampling the scene that moves tell")
        sampled = sampler.sampled(jax.random.key(int(rng.integers(2**31))), start)
    numbers = np.asarray(frame_indices)
    scene = summarise(
        rng, sampled, start, hidden, presence, compared.world_from_camera, objects, numbers, config
    )
    return scene.in_camera(first_camera_from_camera[compared.searched])


def _stand_elsewhere(
    presence: Presence, sampled: Sampled, objects: Sequence[SceneObject]
) -> NDArray[np.bool_]:
    """Which objects (N,) moves have where chains have not been."""
    last = sampled.chains.samples.poses[-1]
    elsewhere = presence.seen.copy()
    for slot, one in enumerate(sampled.found.indices):
        elsewhere[one] &= is_elsewhere(presence.poses[one][None], last[:, slot], objects[one])[0]
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

    rng: np.random.Generator
    joint: JointStart
    objects: Sequence[SceneObject]
    renderer: ObjectRenderer
    noise: DepthNoise
    config: ParseConfig
    progress: Progress | None

    def sampled(self, key: jax.Array, start: Initialisation) -> Sampled:
        """Chains over the objects of a scene, refined first; colours tell how what is round is turned."""
        compared, found = self.joint.compared, FoundObjects.of(start.found)
        chosen, mine = found.taken(self.objects), start.of_slots(found)
        particles = refine_poses(self.rng, compared, self.objects, self.renderer, start, self.config)
        poses = particles[found.placed]
        with jax.enable_x64(True):
            chains = sample_posterior(key, compared, chosen, mine, poses, self.config, self.progress)
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
            turned = with_drawn_turns(self.rng, seen, compared.world_from_camera, chains.samples)
            chains = replace(chains, samples=turned)
        visible = visible_fractions(self.joint, self.renderer, start.found, particles[:, 0])
        return Sampled(found=found, chains=chains, visible_fraction=visible, colour_nats=nats)

    def hidden(self, key: jax.Array) -> HiddenPlaces:
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
