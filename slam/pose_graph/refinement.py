"""Joint refinement of all keyframes: the optimum of their overlaps as a Metropolis-Hastings proposal.

The filter places a keyframe once, at working resolution; errors accumulate along the path. Here every
keyframe's image at full detail is compared with the surfaces of all keyframes that it overlaps, and the graph
of overlaps is brought to its optimum (`slam.pose_graph.gauss_newton`). Particles with the same keyframe poses
form one mode with an optimum of its own. The proposal transports the mode's mean to the optimum; it is its
own inverse and preserves volume, so that the density ratio alone decides. (Decided particle by particle it
was refused at random: densities at single draws differ by tens of nats.) Accepted or not, particles then draw
their displacement from the graph's Gaussian, the Laplace approximation of the same density (docs/model.md,
section J). Reported spreads are that Gaussian's (`RefinedKeyframes`), since a few dozen weighted draws have
no spread in most directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from shapes.geometry.pose_sets import cluster, mean_keyframes
from shapes.geometry.poses import matrices_of
from slam.filter.state import CameraParticles, FilterState
from slam.likelihood.overlap_density import log_overlap_densities
from slam.pose_graph import gauss_newton, sparse_gaussian
from slam.pose_graph.gauss_newton import HELD_INFLATIONS, INFLATIONS, optimise
from slam.pose_graph.overlaps import IMAGE_BUCKET, KeyframeDetail, Keyframes, keyframes_at, relative_to
from slam.pose_graph.trajectory_prior import TrajectoryPrior


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class RefinedKeyframes:
    """Where the modes have the keyframes, before the particles (K,) drew theirs.

    Attributes:
        mode: (K,) index into the modes, -1 for particles of one whose keyframes nothing holds together.
        poses: (G, N, 7) reference_from_keyframe.
        covariances: (G, N, 6, 6) in the charts there.
        held: (G, N) keyframes that overlaps tie to the first; the others are where the particles had them.
    """

    mode: jax.Array
    poses: jax.Array
    covariances: jax.Array
    held: jax.Array


def refine_keyframes(
    key: jax.Array,
    state: FilterState,
    details: Sequence[KeyframeDetail],
    noise: DepthNoise,
    motion: TrajectoryPrior | None = None,
) -> tuple[FilterState, RefinedKeyframes | None]:
    """The state with every particle's keyframes after one Metropolis-Hastings step, and where that led.

    None where no keyframes overlap.

    Args:
        key: consumed.
        state: after the last frame.
        details: of the keyframes.
        noise: the sensor at that detail.
        motion: prior of the keyframes' poses, where it is to have a say.
    """
    particles: CameraParticles = state.population.particles
    used = len(state.keyframe_map)
    poses = np.array(particles.keyframe_poses)
    weights = np.exp(np.asarray(state.population.log_weights, np.float64))
    modes = cluster(matrices_of(poses[:, :used]), weights)
    of_particle = np.full(len(modes), -1, np.int32)
    placed: list[tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_]]] = []
    for mode in range(modes.max() + 1):
        members = modes == mode
        share = jnp.asarray(np.where(members, weights, 0.0) / weights[members].sum())
        filtered = np.asarray(mean_keyframes(particles.keyframe_poses, share))[:used]
        keyframes = keyframes_at(state.keyframe_map, details, matrices_of(filtered), noise)
        inflations = INFLATIONS if motion is None else HELD_INFLATIONS
        found = optimise(keyframes, filtered, inflations, motion=motion)
        if found is None:
            continue
        centres, graph, exponents = found
        draw_key, choice_key = jax.random.split(jax.random.fold_in(key, mode))
        if not _is_accepted(choice_key, keyframes, filtered, centres, exponents, motion):
            centres = filtered
        held = sparse_gaussian.connected_to_first(graph)
        displacements = sparse_gaussian.draws(draw_key, graph, len(modes))
        drawn = gauss_newton.draw_poses(centres, displacements)
        poses[:, :used] = np.where((members[:, None] & held)[..., None], drawn, poses[:, :used])
        of_particle[members] = len(placed)
        placed.append((centres, sparse_gaussian.marginals(graph), held))
    if not placed:
        return state, None
    moved = replace(particles, keyframe_poses=jnp.asarray(poses))
    population = replace(state.population, particles=moved)
    centres, covariances, held = zip(*placed, strict=True)
    return replace(state, population=population), RefinedKeyframes(
        mode=jnp.asarray(of_particle),
        poses=jnp.asarray(np.stack(centres)),
        covariances=jnp.asarray(np.stack(covariances), jnp.float32),
        held=jnp.asarray(np.stack(held)),
    )


def _is_accepted(
    key: jax.Array,
    keyframes: Keyframes,
    before: NDArray[np.float32],
    after: NDArray[np.float32],
    exponents: NDArray[np.float64],
    motion: TrajectoryPrior | None,
) -> bool:
    """Whether keyframes at `before` (N, 7) go to `after` (N, 7); `key` is consumed."""
    log_densities = _log_densities(keyframes, np.stack([before, after]), exponents)
    if motion is not None:
        log_densities += [motion.log_density(matrices_of(poses)) for poses in (before, after)]
    return bool(np.log(float(jax.random.uniform(key))) < log_densities[1] - log_densities[0])


def _log_densities(
    keyframes: Keyframes, poses: NDArray[np.float32], exponents: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Tempered log densities (L,) of all overlaps at keyframes (L, N, 7)."""
    total = np.zeros(len(poses))
    for surface, samples, index, images in keyframes.batches(1):
        padded = np.resize(images, IMAGE_BUCKET)
        relative = _relative_by_image(poses[:, index], poses[:, padded])
        densities = log_overlap_densities(surface, samples, relative, keyframes.noise)
        total += exponents[images] @ np.asarray(densities, np.float64)[: len(images)]
    return total


@jax.jit
def _relative_by_image(origins: jax.Array, poses: jax.Array) -> jax.Array:
    """origin_from_pose (n, L, 7) of L poses (L, 7) and of n others each (L, n, 7)."""
    return jax.vmap(relative_to)(origins, poses).swapaxes(0, 1)
