"""The stage `parse`: from depth frames and known objects to a posterior over scene graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from recordings.types import NO_RETURN, CameraIntrinsics, DepthNoise, Frame
from scene.adaptation import adapted
from scene.chain import Kernel, run_block, scene_kernel
from scene.config import ParseConfig
from scene.contact import TOP_FACE
from scene.depth_images import DepthImages, log_estimates
from scene.detection import SupportPlane
from scene.existence import log_prior_odds
from scene.foreground import frame_data, scene_data
from scene.graph import Bodies, SceneGraph, floating_scene
from scene.initialisation import Initialisation, initialise
from scene.model import ChainState, SceneModel, start_chain
from scene.observation import unprojected
from scene.pair_move import PairMove
from scene.pose_moves import MixtureMove
from scene.poses import composed, pose_of
from scene.prior import PosePrior, UniformTrees
from scene.proposals import pose_proposals, round_axis
from scene.refinement import refine
from scene.rendering import ObjectRenderer
from scene.result import SceneResult
from scene.scene_data import SceneData
from scene.scene_object import SceneObject
from scene.summary import Samples, summarise
from shapes.poses import matrices_of, poses_of

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
NEW_M = 0.015
"""What is so far from all that the first frame shows is new, and counts by cells of that edge."""
AGREE_M = 0.01
LARGEST_VARIANCE = 3.0
"""Of the log likelihood's estimate; above it only a share of the shapes is drawn anew with a pose."""
CORRELATED_SHARE = 0.2
ESTIMATES = 16
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
    """Parse the scene that the frames show: it is judged by all of them.

    It is searched in the first and in the one that shows most of what the first does not, and begins with
    what agrees better with all.

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
    seed_key, search_key, refine_key, chain_key, again_key = jax.random.split(key, 5)
    first = scene_data(frames[0].depth_m, intrinsics, int(jax.random.randint(seed_key, (), 0, 2**31 - 1)))
    views = [first] + [
        frame_data(frame.depth_m, intrinsics, first, pose)
        for frame, pose in zip(frames[1:], first_camera_from_camera[1:], strict=True)
    ]
    renderer = ObjectRenderer.of(objects)
    noise = replace(
        noise,
        outlier_probability=config.outlier_probability,
        none_hit_probability=UNINFORMATIVE,
        none_miss_probability=UNINFORMATIVE,
    )

    def search(key: jax.Array, view: SceneData) -> Initialisation:
        return initialise(
            key,
            view,
            objects,
            renderer,
            noise,
            config.search_error_m,
            log_odds=log_prior_odds(config.presence) / config.pixel_weight,
            rounds=config.rounds,
            pool=config.pool,
        )

    data, start, first_from_searched = first, search(search_key, first), np.eye(4)
    if len(views) > 1:
        other = _most_new(views, first_camera_from_camera)
        again, first_from_other = search(again_key, views[other]), first_camera_from_camera[other]
        agreement = partial(_agreement, renderer, views, first_camera_from_camera)
        if agreement(again, first_from_other) > agreement(start, first_from_searched):
            data, start, first_from_searched = views[other], again, first_from_other
    noise = replace(noise, sigma_base_m=float(np.hypot(noise.sigma_base_m, config.model_error_m)))
    refined = refine(refine_key, data, renderer, start, noise, config.pixel_weight)
    with jax.enable_x64(True):
        camera_from_table = data.table.camera_from_table if data.table else np.eye(4)
        world_from_camera = np.asarray(np.linalg.inv(camera_from_table), np.float64)
        world_from_first = world_from_camera @ np.linalg.inv(first_from_searched)
        poses = [np.linalg.inv(world_from_first @ pose) for pose in first_camera_from_camera]
        likelihood = DepthImages.of(
            views,
            np.stack(poses),
            ObjectRenderer.of_draws(objects) if config.shape_samples else renderer,
            noise,
            config.pixel_weight,
            objects=len(objects),
            draws=max(config.shape_samples, 1),
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
            axes=axes,
            structure=PairMove() if config.graph == "infer" else None,
        )
        samples, variance = _sample(chain_key, model, kernel, axes, start, world, config, progress)
        indices = np.asarray(frame_indices)
        scene = summarise(
            samples, model, start, refined, world_from_camera, objects, indices, config, variance
        )
        return scene.in_camera(first_from_searched)


def _most_new(views: Sequence[SceneData], first_camera_from_camera: NDArray[np.float64]) -> int:
    """The number of the view whose foreground has most points where the first has none near."""

    def points(view: SceneData, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        seen = unprojected(np.asarray(view.view.depth_m), view.view.camera)[view.foreground]
        return seen @ pose[:3, :3].T + pose[:3, 3]

    first, *others = [points(*one) for one in zip(views, first_camera_from_camera, strict=True)]
    tree = KDTree(first)
    new = [np.unique((one[tree.query(one)[0] > NEW_M] // NEW_M), axis=0) for one in others]
    return 1 + int(np.argmax([len(cells) for cells in new]))


def _agreement(
    renderer: ObjectRenderer,
    views: Sequence[SceneData],
    first_camera_from_camera: NDArray[np.float64],
    start: Initialisation,
    first_from_searched: NDArray[np.float64],
) -> float:
    """Mean over views of the share of pixels, of foreground or objects, that show what was measured."""
    found = np.flatnonzero(start.found)
    in_first = first_from_searched @ matrices_of(start.poses[found])
    shares = []
    for view, first_from_camera in zip(views, first_camera_from_camera, strict=True):
        in_view = poses_of(np.linalg.inv(first_from_camera) @ in_first)
        layers_m = renderer.layers(found, in_view, view.window).min(axis=0, initial=np.inf)
        judged = (view.window_foreground | (layers_m < view.rest_m)) & (view.window.depth_m != NO_RETURN)
        error_m = np.abs(np.minimum(layers_m, view.rest_m) - view.window.depth_m)
        shares.append((error_m[judged] < AGREE_M).mean() if judged.any() else 1.0)
    return float(np.mean(shares))


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
) -> tuple[Samples, float]:
    """Chains from the best scene found; the first third of their sweeps teaches the proposals.

    Then the variance of the log likelihood's estimate, which is returned too, tells whether all shapes are
    drawn anew for a new pose, or a share of them.
    """
    start_key, run_key, variance_key = jax.random.split(key, 3)
    spare = len(model.bodies.movable) - len(start.poses)
    states = _start(jax.random.split(start_key, config.chains), model, start.poses, start.found, world, spare)
    if not start.found.any():
        nothing = jnp.zeros_like(states.log_prior)
        recorded = _samples(_scene_and_value(states), nothing)
        return jax.tree.map(lambda leaf: leaf[None], recorded), 0.0
    blocks = BURN_IN_BLOCKS * 3
    count = -(-config.sweeps // blocks)
    kept: list[Samples] = []
    variance = 0.0
    for block in range(blocks):
        block_key = jax.random.fold_in(run_key, block)
        states, scenes, info = run_block(block_key, states, model, kernel, count, _scene_and_value)
        kept.append(_samples(scenes, jnp.mean(info.poses.accepted, axis=-1)))
        if block < BURN_IN_BLOCKS:
            kernel = _taught(kernel, axes, kept.pop())
        if block == BURN_IN_BLOCKS - 1 and config.shape_samples:
            likelihood = model.likelihood
            assert isinstance(likelihood, DepthImages)
            spread = log_estimates(variance_key, likelihood, states.scene, ESTIMATES)
            variance = float(np.median(np.var(spread, axis=0, ddof=1)))
            share = CORRELATED_SHARE if variance > LARGEST_VARIANCE else 1.0
            model = replace(model, likelihood=replace(likelihood, fresh_share=jnp.asarray(share)))
        if progress:
            progress(block + 1, blocks)
    return Samples.joined(kept), variance


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


def _scene_and_value(state: ChainState) -> tuple[SceneGraph, jax.Array]:
    return state.scene, state.log_posterior


def _samples(recorded: tuple[SceneGraph, jax.Array], accepted: jax.Array) -> Samples:
    scene, log_posterior = recorded
    faces = scene.parent_faces, scene.child_faces
    return Samples(scene.poses, scene.parents, *faces, log_posterior, accepted)
