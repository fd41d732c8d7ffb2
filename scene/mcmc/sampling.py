"""The chains of a parse: their target, their kernel, and how they are run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.config import ParseConfig
from scene.execution import FAST_COMPILE
from scene.likelihood.compared_frames import ComparedFrames
from scene.likelihood.depth_images import DepthLikelihood, log_estimates
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.point_clouds import CloudLikelihood
from scene.mcmc.chain_model import carrying, prior_space, scene_model, slabs_under
from scene.mcmc.edges import EdgeMove
from scene.mcmc.kernel import Kernel, run_block, scene_kernel
from scene.mcmc.mixture_adaptation import adapt_mixture
from scene.mcmc.mixture_init import pose_proposals
from scene.mcmc.symmetry_arrays import SpinLines, Symmetries
from scene.model.posterior import ChainState, SceneModel, start_chain
from scene.model.scene_graph import SceneGraph, floating_scene
from scene.objects.scene_object import SceneObject
from scene.search.search_result import Initialisation
from shapes.geometry.poses import pose_of
from shapes.stored_kernels import jit_stored

WALK_M, WALK_RAD = 0.004, 0.05

PRIOR_SHARE = 0.05

LARGEST_VARIANCE = 3.0
"""Of the log likelihood's estimate; above it only a share of the shapes is drawn anew with a pose."""

CORRELATED_SHARE = 0.2

ESTIMATES = 16

BURN_IN_BLOCKS = 2
"""Parts of the run after each of which proposals are fitted anew; as many again, twice, are kept."""

TOGETHER = 8
"""Chains in a kernel; kernels run side by side, each on a core. Of 16 chains groups of eight take two thirds
of the time that four chains of as many moves in groups of two take."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Samples:
    """Kept states of chains: (S, chains, ...) of whole runs, any leading axes before.

    Attributes:
        poses: (..., C, 7) world_from_box.
        parents: (..., C).
        parent_faces: (..., C).
        child_faces: (..., C).
        log_posterior: (...).
        accepted: (...) share of the moves of poses before it that were accepted.
    """

    poses: NDArray[np.float64]
    parents: NDArray[np.int32]
    parent_faces: NDArray[np.int32]
    child_faces: NDArray[np.int32]
    log_posterior: NDArray[np.float64]
    accepted: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SampledScenes:
    """What chains left.

    Attributes:
        samples: that are kept.
        log_estimate_variance: of the log likelihood's estimate.
        model: their target.
    """

    samples: Samples
    log_estimate_variance: float
    model: SceneModel


def sample_posterior(
    key: jax.Array,
    compared: ComparedFrames,
    objects: Sequence[SceneObject],
    start: Initialisation,
    particles: NDArray[np.float64],
    config: ParseConfig,
    progress: Callable[[int, int], None] | None,
) -> SampledScenes:
    """Samples of the scenes that the frames show; supports that carry nothing of the best one are left out.

    Args:
        key: random key.
        compared: the frames.
        objects: that a scene may hold.
        start: the best scene of these objects, in the searched frame's camera.
        particles: (N, P, 7) world_from_box, the densest first, of their poses given the others.
        config: settings.
        progress: called with blocks of moves done and in all.
    """
    likelihood = _likelihood(compared, objects, config)
    world_from_camera = compared.world_from_camera
    starts = particles[start.found, :, 4:].reshape(-1, 3)
    supports = carrying(compared.data.supports, objects, start)
    space = prior_space(compared.data.table, starts)
    model = scene_model(supports, objects, likelihood, space, config)
    world = pose_of(jnp.asarray(world_from_camera))
    slabs = jnp.asarray(slabs_under(supports, world_from_camera))
    bodies = len(model.bodies.movable)
    lines = SpinLines.of(objects, bodies - len(objects))
    kernel = scene_kernel(
        pose_proposals(start, particles, world, lines),
        prior_share=PRIOR_SHARE,
        translation_m=jax.device_put(np.full(bodies, WALK_M)),
        rotation_rad=jax.device_put(np.full(bodies, WALK_RAD)),
        lines=lines,
        symmetries=Symmetries.of(objects, bodies - len(objects)),
        structure=EdgeMove() if config.graph == "infer" else None,
        repeats=max(len(objects) - 1, 1),
    )
    return _sample(key, model, kernel, lines, start.found, particles, slabs, config, progress)


def _likelihood(
    compared: ComparedFrames, objects: Sequence[SceneObject], config: ParseConfig
) -> DepthLikelihood:
    images = DepthLikelihood.of(
        compared.views,
        compared.densities,
        compared.camera_from_world,
        ObjectRenderer.of_draws(objects) if config.shape_samples else ObjectRenderer.of(objects),
        objects=len(objects),
        draws=max(config.shape_samples, 1),
        colours=compared.colours_of(objects),
    )
    if config.likelihood == "depth":
        return images
    return CloudLikelihood.over(
        images,
        compared.views,
        outlier_probability=config.cloud_outlier_probability,
        radius_m=config.cloud_radius_m,
    )


def _sample(
    key: jax.Array,
    model: SceneModel,
    kernel: Kernel,
    lines: SpinLines,
    found: NDArray[np.bool_],
    particles: NDArray[np.float64],
    slabs: jax.Array,
    config: ParseConfig,
    progress: Callable[[int, int], None] | None,
) -> SampledScenes:
    """Chains from particles of every object; these and the first third of their sweeps teach the proposals.

    Then the variance of the log likelihood's estimate tells whether all shapes are drawn anew for a new pose,
    or a share of them.
    """
    start_key, order_key, run_key, variance_key = jax.random.split(key, 4)
    keys = jax.random.split(start_key, config.chains)
    states = _start(keys, model, jnp.asarray(particles), jnp.asarray(found), slabs)
    if not found.any():
        nothing = jnp.zeros_like(states.log_prior)
        recorded = _samples(_scene_and_value(states), nothing)
        return SampledScenes(jax.tree.map(lambda leaf: leaf[None], recorded), 0.0, model)
    groups = [
        jax.tree.map(lambda leaf, first=first: np.asarray(leaf)[first : first + TOGETHER], states)
        for first in range(0, config.chains, TOGETHER)
    ]
    blocks = BURN_IN_BLOCKS * 3
    count = -(-config.sweeps // blocks)
    kept: list[Samples] = []
    variance = 0.0
    order = np.resize(jax.random.permutation(order_key, particles.shape[1]), count * config.chains)
    resting = np.repeat(np.asarray(slabs)[:, None], len(order), axis=1)
    kernel = _taught(kernel, lines, np.concatenate([particles[:, order], resting]).swapaxes(0, 1))
    for block in range(blocks):
        block_keys = jax.random.split(jax.random.fold_in(run_key, block), len(groups))
        groups, samples = _advanced(block_keys, groups, model, kernel, count)
        if block < BURN_IN_BLOCKS:
            kernel = _taught(kernel, lines, samples.poses)
        else:
            kept.append(samples)
        if block == BURN_IN_BLOCKS - 1 and config.shape_samples:
            likelihood = model.likelihood
            assert isinstance(likelihood, DepthLikelihood)
            keys = jax.random.split(variance_key, len(groups))
            spread = [
                log_estimates(key, likelihood, one.scene, ESTIMATES)
                for key, one in zip(keys, groups, strict=True)
            ]
            variance = float(np.median(np.var(np.concatenate(spread, axis=1), axis=0, ddof=1)))
            share = CORRELATED_SHARE if variance > LARGEST_VARIANCE else 1.0
            share = jnp.asarray(share, likelihood.fresh_share.dtype)  # another one is another kernel
            model = replace(model, likelihood=replace(likelihood, fresh_share=share))
        if progress:
            progress(block + 1, blocks)
    return SampledScenes(jax.tree.map(lambda *leaves: np.concatenate(leaves), *kept), variance, model)


def _advanced(
    keys: jax.Array, groups: Sequence[ChainState], model: SceneModel, kernel: Kernel, count: int
) -> tuple[list[ChainState], Samples]:
    """Groups of chains after `count` sweeps more, side by side on all cores, and the states of all chains."""

    def run(key: jax.Array, states: ChainState) -> tuple[ChainState, Samples]:
        with jax.enable_x64(True):  # of this thread
            states, scenes, accepted = run_block(key, states, model, kernel, count, _scene_and_value)
            states = jax.tree.map(np.asarray, states)  # what a device holds would be compiled for once more
            return states, _samples(scenes, np.mean(np.asarray(accepted), axis=-1))

    with ThreadPoolExecutor(len(groups)) as cores:
        states, samples = zip(*cores.map(run, keys, groups), strict=True)
    return list(states), jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *samples)


def _taught(kernel: Kernel, lines: SpinLines, poses: NDArray[np.float64]) -> Kernel:
    """The kernel with proposals fitted to poses (..., C, 7) that bodies were at."""
    states = poses.reshape(-1, *poses.shape[-2:])
    return kernel.with_mixture(adapt_mixture(kernel.mixture, lines, states))


@jit_stored(compiler_options=FAST_COMPILE)
def _start(
    keys: jax.Array, model: SceneModel, particles: jax.Array, found: jax.Array, slabs: jax.Array
) -> ChainState:
    """The states of chains, everything floating, each object at one of its particles.

    Args:
        keys: (B,).
        model: the target.
        particles: (N, P, 7) world_from_box.
        found: (N,).
        slabs: (S, 7) poses of the supports.
    """
    present = jnp.concatenate([found, jnp.ones(len(slabs), bool)])

    def start(key: jax.Array) -> ChainState:
        particle_key, chain_key = jax.random.split(key)
        chosen = jax.random.randint(particle_key, found.shape, 0, particles.shape[1])
        poses = jnp.take_along_axis(particles, chosen[:, None, None], axis=1)[:, 0]
        return start_chain(chain_key, model, floating_scene(jnp.concatenate([poses, slabs]), present))

    return jax.vmap(start)(keys)


def _scene_and_value(state: ChainState) -> tuple[SceneGraph, jax.Array]:
    return state.scene, state.log_posterior


def _samples(recorded: tuple[SceneGraph, jax.Array], accepted: jax.Array) -> Samples:
    scene, log_posterior = recorded
    faces = scene.parent_faces, scene.child_faces
    leaves = scene.poses, scene.parents, *faces, log_posterior, accepted
    return Samples(*map(np.asarray, leaves))
