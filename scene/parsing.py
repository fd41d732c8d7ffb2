"""The stage `parse`: from depth frames and known objects to a posterior over scene graphs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

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
from scene.likelihood.compared_frames import ComparedFrames
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.mcmc.chain_model import carrying
from scene.mcmc.colour_turns import SeenColours, with_drawn_turns
from scene.mcmc.sampling import SampledScenes, sample_posterior
from scene.objects.scene_object import SceneObject
from scene.objects.slots import FoundObjects
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import scene_views
from scene.presence.inference import presence_in_scene
from scene.refinement import refine_poses
from scene.result import SceneResult
from scene.search.search_result import Initialisation
from scene.summary import summarise
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

    Where moves put in an object that the search had rejected, chains run again over the scene that they tell.

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
    compared, start = joint.compared, joint.start
    rng = np.random.default_rng(np.asarray(jax.random.key_data(presence_key)))
    seen_noise = with_surface_error(noise, config.model_error_m)
    sampled = partial(_sampled, rng, joint, objects, renderer, config, progress)
    best = sampled(chain_key, start)
    tell("weighing where objects may be out of sight")
    hidden = _hidden(hidden_key, compared, objects, start, seen_noise, config)
    tell("weighing which objects are there")
    presence = presence_in_scene(
        rng, compared, joint.searched, objects, start, best.found, best.chains, hidden, config
    )
    if (presence.seen & ~start.found).any():
        in_camera = poses_of(np.linalg.inv(compared.world_from_camera) @ matrices_of(presence.poses))
        start = start.with_scene(presence.seen, in_camera)
        tell("sampling the scene with what was added")
        best = sampled(jax.random.key(int(rng.integers(2**31))), start)
    scene = summarise(
        rng,
        best.chains,
        best.found,
        start,
        best.visible_fraction,
        best.colour_nats,
        hidden,
        presence,
        compared.world_from_camera,
        objects,
        np.asarray(frame_indices),
        config,
    )
    return scene.in_camera(first_camera_from_camera[compared.searched])


def _untold(name: str) -> None:
    """Nobody wants to know."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Sampled:
    """What chains tell of one scene.

    Attributes:
        found: the objects that they looked at.
        chains: their samples.
        visible_fraction: (N,) of all objects.
        colour_nats: (N,).
    """

    found: FoundObjects
    chains: SampledScenes
    visible_fraction: NDArray[np.float64]
    colour_nats: NDArray[np.float64]


def _sampled(
    rng: np.random.Generator,
    joint: JointStart,
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    config: ParseConfig,
    progress: Progress | None,
    chain_key: jax.Array,
    start: Initialisation,
) -> _Sampled:
    """Chains over the objects of a scene, refined first; colours tell how what is round is turned."""
    compared, found = joint.compared, FoundObjects.of(start.found)
    chosen, their_start = found.taken(objects), start.of_slots(found)
    particles = refine_poses(rng, compared, objects, renderer, start, config)
    with jax.enable_x64(True):
        chains = sample_posterior(
            chain_key, compared, chosen, their_start, particles[found.placed], config, progress
        )
    nats = np.zeros(len(objects))
    if compared.colours is not None:
        best = their_start.poses[found.present]
        seen = SeenColours(
            compared.data, compared.colours, renderer, objects, found.indices, best, config.colour_weight
        )
        nats[found.indices] = seen.log_factors()
        turned = with_drawn_turns(rng, seen, compared.world_from_camera, chains.samples)
        chains = replace(chains, samples=turned)
    visible = visible_fractions(joint, renderer, start.found, particles[:, 0])
    return _Sampled(found=found, chains=chains, visible_fraction=visible, colour_nats=nats)


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


def _hidden(
    key: jax.Array,
    compared: ComparedFrames,
    objects: Sequence[SceneObject],
    start: Initialisation,
    noise: DepthNoise,
    config: ParseConfig,
) -> HiddenPlaces:
    """Where objects may be out of sight; the scene is in the searched frame's camera."""
    world_from_camera = compared.world_from_camera
    world_from_box = world_from_camera @ matrices_of(start.poses)
    return hidden_places(
        np.random.default_rng(np.asarray(jax.random.key_data(key))),
        compared.views,
        compared.camera_from_world,
        [
            Support(world_from_support=world_from_camera @ one.camera_from_table, half_size_m=one.half_size_m)
            for one in carrying(compared.data.supports, objects, start)
        ],
        compared.camera_from_world[0],
        objects,
        {
            one: PlacedObject(shape=objects[one], world_from_box=world_from_box[one])
            for one in np.flatnonzero(start.found).tolist()
        },
        noise,
        config,
    )
