"""Joint refinement of all keyframes: the optimum of their overlaps as a Metropolis-Hastings proposal.

The filter places a keyframe once, at working resolution; errors accumulate along the path. Here every
keyframe's image at full detail is compared with the surfaces of all keyframes that it overlaps, and the graph
of overlaps is brought to its optimum (`slam.pose_graph.gauss_newton`). Particles with the same keyframe poses
form one mode with an optimum of its own. The proposal transports the mode's mean to the optimum; it is its
own inverse and preserves volume, so that the density ratio alone decides. (Decided particle by particle it
was refused at random: densities at single draws differ by tens of nats.) Accepted or not, particles then draw
their displacement from the graph's Gaussian, the Laplace approximation of the same density (docs/model.md,
section J). Reported spreads are that Gaussian's (`RefinedKeyframes`), since a few dozen weighted draws have
no spread in most directions. The sensor's distortion field is one more unknown of each mode: an error that
all frames share, which no number of them averages out.
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
from slam.likelihood.distortion import node_factor
from slam.likelihood.overlap_density import log_overlap_densities
from slam.pose_graph import gauss_newton, sparse_gaussian
from slam.pose_graph.gauss_newton import (
    HELD_INFLATIONS,
    INFLATIONS,
    Distortion,
    FieldOptimum,
    optimise,
    optimise_with_distortion,
)
from slam.pose_graph.overlaps import IMAGE_BUCKET, KeyframeDetail, Keyframes, keyframes_at, relative_to
from slam.pose_graph.trajectory_prior import TrajectoryPrior


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class RefinedKeyframes:
    """Where the modes have the keyframes, before the particles (K,) drew theirs, and the distortion field.

    Attributes:
        mode: (K,) index into the modes.
        poses: (G, N, 7) reference_from_keyframe.
        covariances: (G, N, 6, 6) in the charts there, given the field.
        held: (G, N) keyframes that overlaps tie to the first; the others are where the particles had them.
        factor: (NODES, F) by which the field's nodes follow its coordinates.
        field: (G, F) the coordinates' mean.
        field_covariance: (G, F, F).
        field_draws: (K, F) each particle's coordinates.
        sensitivity: (G, N, 6, F) how keyframes follow the coordinates.
    """

    mode: jax.Array
    poses: jax.Array
    covariances: jax.Array
    held: jax.Array
    factor: jax.Array
    field: jax.Array
    field_covariance: jax.Array
    field_draws: jax.Array
    sensitivity: jax.Array


@dataclass(frozen=True, kw_only=True)
class _Mode:
    """One mode's share of `RefinedKeyframes`, and draws for all particles: (K, N, 7) and (K, F)."""

    poses: NDArray[np.float32]
    covariances: NDArray[np.float64]
    held: NDArray[np.bool_]
    field: NDArray[np.float64]
    field_covariance: NDArray[np.float64]
    sensitivity: NDArray[np.float64]
    drawn: NDArray[np.float32]
    field_drawn: NDArray[np.float64]


def refine_keyframes(
    key: jax.Array,
    state: FilterState,
    details: Sequence[KeyframeDetail],
    noise: DepthNoise,
    sd_per_m: NDArray[np.float64],
    motion: TrajectoryPrior | None = None,
) -> tuple[FilterState, RefinedKeyframes]:
    """The state with every particle's keyframes after one Metropolis-Hastings step, and where that led.

    Args:
        key: consumed.
        state: after the last frame.
        details: of the keyframes.
        noise: the sensor at that detail.
        sd_per_m: (rows, columns) deviations of the distortion field's nodes, a priori.
        motion: prior of the keyframes' poses, where it is to have a say.
    """
    particles: CameraParticles = state.population.particles
    used = len(state.keyframe_map)
    poses = np.array(particles.keyframe_poses)
    weights = np.exp(np.asarray(state.population.log_weights, np.float64))
    groups = cluster(matrices_of(poses[:, :used]), weights)
    unknown = Distortion.unknown(node_factor(sd_per_m))
    field_draws = np.zeros((len(groups), len(unknown.coordinates)))
    modes: list[_Mode] = []
    for group in range(groups.max() + 1):
        members = groups == group
        share = jnp.asarray(np.where(members, weights, 0.0) / weights[members].sum())
        filtered = np.asarray(mean_keyframes(particles.keyframe_poses, share))[:used]
        keyframes = keyframes_at(state.keyframe_map, details, matrices_of(filtered), noise)
        group_key = jax.random.fold_in(key, group)
        mode = _refined(group_key, keyframes, details, filtered, unknown, motion, len(groups))
        poses[:, :used] = np.where((members[:, None] & mode.held)[..., None], mode.drawn, poses[:, :used])
        field_draws[members] = mode.field_drawn[members]
        modes.append(mode)
    moved = replace(particles, keyframe_poses=jnp.asarray(poses))

    def stacked(name: str) -> jax.Array:
        leaves = np.stack([getattr(mode, name) for mode in modes])
        return jnp.asarray(leaves, bool if name == "held" else jnp.float32)

    told = ("poses", "covariances", "held", "field", "field_covariance", "sensitivity")
    return replace(state, population=replace(state.population, particles=moved)), RefinedKeyframes(
        mode=jnp.asarray(groups, jnp.int32),
        factor=jnp.asarray(unknown.factor, jnp.float32),
        field_draws=jnp.asarray(field_draws, jnp.float32),
        **{name: stacked(name) for name in told},
    )


def _refined(
    key: jax.Array,
    keyframes: Keyframes,
    details: Sequence[KeyframeDetail],
    filtered: NDArray[np.float32],
    unknown: Distortion,
    motion: TrajectoryPrior | None,
    count: int,
) -> _Mode:
    """One mode, refined from where the filter has its keyframes (N, 7); `count` particles draw.

    Twice: planes that were fitted to distorted depths do not bend with the field.
    """
    draw_key, choice_key = jax.random.split(key)
    start = optimise(keyframes, filtered, INFLATIONS if motion is None else HELD_INFLATIONS, motion=motion)
    found = start and optimise_with_distortion(keyframes, start, unknown, motion)
    if found is not None:
        disparity = jnp.asarray(found.distortion.disparity_per_m, jnp.float32)
        corrected = [detail.without_distortion(disparity, keyframes.noise) for detail in details]
        keyframes, removed = keyframes.of(corrected), found.distortion.removed()
        found = optimise_with_distortion(keyframes, found, removed, motion)
    if found is None:
        return _unrefined(draw_key, filtered, unknown, count)
    if not _is_accepted(choice_key, keyframes, filtered, found, motion):
        found = replace(
            found,
            poses=filtered,
            distortion=replace(found.distortion, coordinates=0.0 * found.distortion.coordinates),
        )
    field = sparse_gaussian.field_posterior(found.graph)
    displacements, of_field = sparse_gaussian.draws(draw_key, found.graph, count)
    return _Mode(
        poses=found.poses,
        covariances=sparse_gaussian.conditional_marginals(found.graph),
        held=sparse_gaussian.connected_to_first(found.graph),
        field=found.distortion.coordinates,
        field_covariance=field.covariance,
        sensitivity=field.sensitivity,
        drawn=gauss_newton.draw_poses(found.poses, displacements),
        field_drawn=found.distortion.coordinates + of_field,
    )


def _unrefined(key: jax.Array, poses: NDArray[np.float32], unknown: Distortion, count: int) -> _Mode:
    """A mode (N, 7) whose keyframes nothing holds together: the field is what it was a priori."""
    size, used = len(unknown.coordinates), len(poses)
    return _Mode(
        poses=poses,
        covariances=np.zeros((used, 6, 6)),
        held=np.zeros(used, bool),
        field=unknown.coordinates,
        field_covariance=np.eye(size),
        sensitivity=np.zeros((used, 6, size)),
        drawn=np.tile(poses, (count, 1, 1)),
        field_drawn=np.asarray(jax.random.normal(key, (count, size)), np.float64),
    )


def _is_accepted(
    key: jax.Array,
    keyframes: Keyframes,
    before: NDArray[np.float32],
    after: FieldOptimum,
    motion: TrajectoryPrior | None,
) -> bool:
    """Whether keyframes at `before` (N, 7), without distortion, go to `after`; `key` is consumed."""
    distortion, poses = after.distortion, np.stack([before, after.poses])
    coordinates = np.stack([0.0 * distortion.coordinates, distortion.coordinates])
    disparities = coordinates @ distortion.factor.T - distortion.removed_per_m
    log_densities = _log_densities(keyframes, poses, disparities, after.exponents)
    log_densities -= 0.5 * (coordinates**2).sum(axis=1)
    if motion is not None:
        log_densities += [motion.log_density(matrices_of(one)) for one in poses]
    return bool(np.log(float(jax.random.uniform(key))) < log_densities[1] - log_densities[0])


def _log_densities(
    keyframes: Keyframes,
    poses: NDArray[np.float32],
    disparities_per_m: NDArray[np.float64],
    exponents: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Tempered log densities (L,) of all overlaps at keyframes (L, N, 7) and fields (L, NODES)."""
    total, fields = np.zeros(len(poses)), disparities_per_m.astype(np.float32)
    for surface, samples, index, images in keyframes.batches(1):
        padded = np.resize(images, IMAGE_BUCKET)
        relative = _relative_by_image(poses[:, index], poses[:, padded])
        densities = log_overlap_densities(surface, samples, relative, keyframes.noise, fields)
        total += exponents[images] @ np.asarray(densities, np.float64)[: len(images)]
    return total


@jax.jit
def _relative_by_image(origins: jax.Array, poses: jax.Array) -> jax.Array:
    """origin_from_pose (n, L, 7) of L poses (L, 7) and of n others each (L, n, 7)."""
    return jax.vmap(relative_to)(origins, poses).swapaxes(0, 1)
