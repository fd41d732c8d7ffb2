"""The stage `parse`: from depth frames and known objects to a posterior over scene graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics, DepthNoise, Frame
from scene.adaptation import adapted
from scene.chain import Kernel, run_block, scene_kernel
from scene.config import ParseConfig
from scene.contact import TOP_FACE
from scene.depth_images import DepthImages
from scene.detection import SupportPlane
from scene.foreground import frame_data, scene_data
from scene.graph import Bodies, floating_scene
from scene.initialisation import Initialisation, initialise
from scene.model import ChainState, SceneModel, start_chain
from scene.pose_moves import MixtureMove
from scene.poses import composed, pose_of
from scene.prior import PosePrior, UniformTrees
from scene.proposals import pose_proposals, round_axis
from scene.refinement import refine
from scene.rendering import ObjectRenderer
from scene.result import SceneResult
from scene.scene_data import SceneData
from scene.scene_object import SceneObject
from scene.structure_move import StructureMove
from scene.summary import Samples, summarise

HEIGHT_M = 0.6
"""Floating objects are up to this far over the table."""
TABLE_HALF_THICKNESS_M = 0.01
FREE_HALF_SIZE_M = 1.5
"""Of the cuboid in front of the camera that holds objects where there is no table."""
SPACE_MARGIN_M = 0.05
"""Of that cuboid round the places where chains start."""
UNINFORMATIVE = 0.5
"""Probability of no return, with and without a surface: dark and grazing surfaces make it say little."""
WALK_M, WALK_RAD = 0.004, 0.05
PRIOR_SHARE = 0.05
BURN_IN_BLOCKS = 2
"""Parts of the run after each of which proposals are fitted anew; as many again, twice, are kept."""


def parse_scene(
    key: jax.Array,
    frames: Sequence[Frame],
    frame_indices: Sequence[int],
    first_camera_from_camera: NDArray[np.float64],
    intrinsics: CameraIntrinsics,
    noise: DepthNoise,
    objects: Sequence[SceneObject],
    config: ParseConfig,
    progress: Callable[[int, int], None] | None = None,
) -> SceneResult:
    """Parse the scene that the frames show.

    Args:
        key: random key.
        frames: depth frames of a scene at rest, at least one.
        frame_indices: their numbers in the recording.
        first_camera_from_camera: (F, 4, 4) poses relative to the first of them.
        intrinsics: of the camera.
        noise: of the sensor.
        objects: what to look for.
        config: settings.
        progress: called with blocks of moves done and in all.

    Raises:
        ValueError: the first frame shows nothing to parse.
    """
    seed_key, search_key, refine_key, chain_key = jax.random.split(key, 4)
    data = scene_data(frames[0].depth_m, intrinsics, int(jax.random.randint(seed_key, (), 0, 2**31 - 1)))
    renderer = ObjectRenderer.of(objects)
    noise = replace(
        noise,
        outlier_probability=config.outlier_probability,
        none_hit_probability=UNINFORMATIVE,
        none_miss_probability=UNINFORMATIVE,
    )
    start = initialise(
        search_key,
        data,
        objects,
        renderer,
        noise,
        config.search_error_m,
        rounds=config.rounds,
        pool=config.pool,
    )
    noise = replace(noise, sigma_base_m=float(np.hypot(noise.sigma_base_m, config.model_error_m)))
    refined = refine(refine_key, data, renderer, start, noise, config.pixel_weight)
    views = [data] + [
        frame_data(frame.depth_m, intrinsics, data, pose)
        for frame, pose in zip(frames[1:], first_camera_from_camera[1:], strict=True)
    ]
    with jax.enable_x64(True):
        camera_from_table = data.table.camera_from_table if data.table else np.eye(4)
        world_from_camera = np.asarray(np.linalg.inv(camera_from_table), np.float64)
        poses = [np.linalg.inv(world_from_camera @ pose) for pose in first_camera_from_camera]
        likelihood = DepthImages.of(
            views, np.stack(poses), renderer, noise, config.pixel_weight, objects=len(objects)
        )
        rotation, translation = world_from_camera[:3, :3], world_from_camera[:3, 3]
        starts = start.poses[start.found, 4:] @ rotation.T + translation
        model = _model(data, objects, likelihood, space_of(data.table, starts), config)
        world = pose_of(jnp.asarray(world_from_camera))
        bodies = len(model.bodies.movable)
        axes = jnp.asarray([round_axis(one) for one in objects] + [-1] * (bodies - len(objects)))
        mixture = pose_proposals(start, refined, config.pixel_weight, world, axes)
        kernel = scene_kernel(
            mixture,
            prior_share=PRIOR_SHARE,
            translation_m=jnp.full(bodies, WALK_M),
            rotation_rad=jnp.full(bodies, WALK_RAD),
            structure=StructureMove() if config.graph == "infer" else None,
        )
        samples = _sample(chain_key, model, kernel, axes, start, world, config, progress)
        indices = np.asarray(frame_indices)
        return summarise(samples, model, start, refined, world_from_camera, objects, indices, config)


def space_of(
    table: SupportPlane | None, starts_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of the cuboid that holds floating objects: over the table, or before the camera without one.

    It is widened to hold the centres (N, 3) where chains start, so that none starts where it cannot be.
    """
    if table is None:
        low = np.array([-FREE_HALF_SIZE_M, -FREE_HALF_SIZE_M, 0.0])
        high = np.array([FREE_HALF_SIZE_M, FREE_HALF_SIZE_M, 2 * FREE_HALF_SIZE_M])
    else:
        low = np.append(-table.half_size_m, -TABLE_HALF_THICKNESS_M)
        high = np.append(table.half_size_m, HEIGHT_M)
    return (
        np.minimum(low, np.min(starts_m - SPACE_MARGIN_M, axis=0, initial=np.inf)),
        np.maximum(high, np.max(starts_m + SPACE_MARGIN_M, axis=0, initial=-np.inf)),
    )


def _model(
    data: SceneData,
    objects: Sequence[SceneObject],
    likelihood: DepthImages,
    space: tuple[NDArray[np.float64], NDArray[np.float64]],
    config: ParseConfig,
) -> SceneModel:
    """The target in the table's frame; the table is the last body, a slab under z = 0."""
    half_extents = [one.half_extents_m for one in objects]
    movable = [True] * len(objects)
    supporting = [[True] * 6 for _ in objects]
    if data.table is not None:
        half_extents.append(np.append(data.table.half_size_m, TABLE_HALF_THICKNESS_M))
        movable.append(False)
        supporting.append([face == TOP_FACE for face in range(6)])
    bodies = Bodies(jnp.asarray(np.stack(half_extents)), jnp.asarray(movable), jnp.asarray(supporting))
    prior = PosePrior(
        low_m=jnp.asarray(space[0]),
        high_m=jnp.asarray(space[1]),
        contact_sigma_m=jnp.asarray(config.contact_sigma_m),
        contact_concentration=jnp.asarray(config.contact_concentration),
        slack_share=jnp.asarray(config.slack_share),
    )
    return SceneModel(bodies, prior, UniformTrees(), likelihood)


def _sample(
    key: jax.Array,
    model: SceneModel,
    kernel: Kernel,
    axes: jax.Array,
    start: Initialisation,
    world: jax.Array,
    config: ParseConfig,
    progress: Callable[[int, int], None] | None,
) -> Samples:
    """Chains from the best scene found; the first third of their sweeps teaches the proposals."""
    start_key, run_key = jax.random.split(key)
    spare = len(model.bodies.movable) - len(start.poses)
    states = _start(jax.random.split(start_key, config.chains), model, start.poses, start.found, world, spare)
    if not start.found.any():
        return jax.tree.map(lambda leaf: leaf[None], jax.vmap(_recorded)(states))
    blocks = BURN_IN_BLOCKS * 3
    count = -(-config.sweeps // blocks)
    kept: list[Samples] = []
    for block in range(blocks):
        block_key = jax.random.fold_in(run_key, block)
        states, recorded, _ = run_block(block_key, states, model, kernel, count, _recorded)
        kept.append(recorded)
        if block < BURN_IN_BLOCKS:
            kernel = _taught(kernel, axes, recorded)
            kept.clear()
        if progress:
            progress(block + 1, blocks)
    return Samples.joined(kept)


def _taught(kernel: Kernel, axes: jax.Array, states: Samples) -> Kernel:
    """The kernel with proposals fitted to the states that its chains went through."""
    states = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), states)
    mixture = adapted(kernel.candidates.offer.mixture, axes, states.poses, states.log_posterior)
    draw = replace(kernel.candidates.offer, mixture=mixture)
    others = tuple(draw if isinstance(move, MixtureMove) else move for move in kernel.others)
    return replace(kernel, candidates=replace(kernel.candidates, offer=draw), others=others)


@partial(jax.jit, static_argnames="spare")
def _start(
    keys: jax.Array, model: SceneModel, poses: jax.Array, found: jax.Array, world: jax.Array, spare: int
) -> ChainState:
    """The states of chains that all start at these poses (N, 7) camera_from_box, everything floating."""
    poses = jax.vmap(lambda pose: composed(world, pose))(poses)
    table = jnp.tile(jnp.asarray([[1.0, 0, 0, 0, 0, 0, -TABLE_HALF_THICKNESS_M]]), (spare, 1))
    scene = floating_scene(jnp.concatenate([poses, table]), jnp.concatenate([found, jnp.ones(spare, bool)]))
    return jax.vmap(lambda key: start_chain(key, model, scene))(keys)


def _recorded(state: ChainState) -> Samples:
    scene = state.scene
    return Samples(scene.poses, scene.parents, scene.parent_faces, scene.child_faces, state.log_posterior)
