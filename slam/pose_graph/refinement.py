"""Joint refinement of all keyframes: the optimum of their overlaps, and its Laplace approximation.

The filter places a keyframe once, at working resolution; errors accumulate along the path. Here every
keyframe's image at full detail is compared with the surfaces of all keyframes that it overlaps, and the graph
of overlaps is brought to its optimum (`slam.pose_graph.gauss_newton`). Particles with the same keyframe poses
form one mode with an optimum of its own, and draw their displacement from the graph's Gaussian there, the
Laplace approximation of the overlaps' density (docs/model.md, section J). Reported spreads are that
Gaussian's (`RefinedKeyframes`), since a few dozen weighted draws have no spread in most directions. The
sensor's distortion field is an error that all frames share, which no number of them averages out: poses
follow it, and its prior is in what is told of them (a consider parameter; Schmidt 1966), scaled to what the
recording tells of it (`slam.pose_graph.distortion_scale`). It is estimated jointly with the poses for the
sensor's profile, by which frames may be corrected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from shapes.geometry.pose_sets import cluster
from shapes.geometry.poses import matrices_of
from slam.filter.state import FilterState
from slam.keyframes.pages import Paged
from slam.likelihood.distortion import Distortion, node_factor
from slam.pose_graph import sparse_gaussian
from slam.pose_graph.coarse_to_fine import optimise_coarse_to_fine
from slam.pose_graph.displacements import draw_poses, mean_poses
from slam.pose_graph.distortion_scale import ScaledField, scaled_field, unseen_field
from slam.pose_graph.gauss_newton import (
    THINNED,
    GraphOptimum,
    optimise_with_distortion,
    with_distortion,
)
from slam.pose_graph.overlaps import KeyframeDetail, KeyframeImages, Keyframes
from slam.pose_graph.trajectory_prior import TrajectoryPrior

FIELD_KEYFRAMES = 200
"""Search effort: an hour's film has thousands, and the field has 62 coordinates."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class PlacedKeyframes:
    """Keyframes of G modes, each looked up in a place of a table (...); leaves as in `RefinedKeyframes`.

    Attributes:
        poses: (G, ..., 7).
        covariances: (G, ..., 6, 6).
        held: (G, ...).
        sensitivity: (G, ..., 6, F).
    """

    poses: jax.Array
    covariances: jax.Array
    held: jax.Array
    sensitivity: jax.Array


@dataclass(frozen=True, kw_only=True)
class RefinedKeyframes:
    """Where the modes have the keyframes, before the particles (K,) drew theirs, and the distortion field.

    The field's coordinates are independent unit Gaussians a priori; nodes are `factor` times coordinates.

    Attributes:
        mode: (K,) index into the modes.
        poses: (G, N, 7) reference_from_keyframe.
        covariances: (G, N, 6, 6) in the charts there, given the field.
        held: (G, N) keyframes that overlaps tie to the first; the others are where the particles had them.
        sensitivity: (G, N, 6, F) how keyframes follow the field's coordinates.
        factor: (G, NODES, F), as strong as the recording tells.
        disparity_per_m: (G, NODES) the field's mean, as it is estimated jointly with the poses.
        sd_per_m: (G, NODES) its standard deviations.
    """

    mode: NDArray[np.int_]
    poses: NDArray[np.float32]
    covariances: NDArray[np.float64]
    held: NDArray[np.bool_]
    sensitivity: NDArray[np.float64]
    factor: NDArray[np.float64]
    disparity_per_m: NDArray[np.float64]
    sd_per_m: NDArray[np.float64]

    def at(self, keyframes: NDArray[np.integer]) -> PlacedKeyframes:
        """Of the keyframes with these indices (...)."""
        return PlacedKeyframes(
            poses=jnp.asarray(self.poses[:, keyframes]),
            covariances=jnp.asarray(self.covariances[:, keyframes], jnp.float32),
            held=jnp.asarray(self.held[:, keyframes]),
            sensitivity=jnp.asarray(self.sensitivity[:, keyframes], jnp.float32),
        )


@dataclass(frozen=True, kw_only=True)
class _Mode:
    """One mode's share of `RefinedKeyframes`, and draws (K, N, 7) for all particles."""

    poses: NDArray[np.float32]
    covariances: NDArray[np.float64]
    held: NDArray[np.bool_]
    sensitivity: NDArray[np.float64]
    factor: NDArray[np.float64]
    disparity_per_m: NDArray[np.float64]
    sd_per_m: NDArray[np.float64]
    drawn: NDArray[np.float32]


def refine_keyframes(
    key: jax.Array,
    state: FilterState,
    details: Sequence[Paged[KeyframeDetail]],
    noise: DepthNoise,
    sd_per_m: NDArray[np.float64],
    motion: TrajectoryPrior | None = None,
    scales: Sequence[float] = (1.0,),
) -> tuple[FilterState, RefinedKeyframes]:
    """The state with every particle's keyframes drawn about the optimum, and what that is.

    Args:
        key: consumed.
        state: after the last frame.
        details: of the keyframes.
        noise: the sensor at that detail.
        sd_per_m: (rows, columns) deviations of the distortion field's nodes, a priori.
        motion: prior of the keyframes' poses, where it is to have a say.
        scales: factors of `sd_per_m`, equally likely.
    """
    poses = state.keyframe_poses.copy()
    weights = np.exp(np.asarray(state.population.log_weights, np.float64))
    groups = cluster(matrices_of(poses), weights)
    unknown = Distortion.unknown(node_factor(sd_per_m))
    modes: list[_Mode] = []
    for group in range(groups.max() + 1):
        members = groups == group
        share = jnp.asarray(np.where(members, weights, 0.0) / weights[members].sum())
        filtered = mean_poses(state.keyframe_poses, share)
        images = KeyframeImages(keyframe_map=state.keyframe_map, details=details, noise=noise)
        group_key = jax.random.fold_in(key, group)
        mode = _refined(group_key, images, filtered, unknown, scales, motion, len(groups))
        poses = np.where((members[:, None] & mode.held)[..., None], mode.drawn, poses)
        modes.append(mode)

    told = ("poses", "covariances", "held", "sensitivity", "factor", "disparity_per_m", "sd_per_m")
    return replace(state, keyframe_poses=poses), RefinedKeyframes(
        mode=groups, **{name: np.stack([getattr(mode, name) for mode in modes]) for name in told}
    )


def _refined(
    key: jax.Array,
    images: KeyframeImages,
    filtered: NDArray[np.float32],
    unknown: Distortion,
    scales: Sequence[float],
    motion: TrajectoryPrior | None,
    count: int,
) -> _Mode:
    """One mode, refined from where the filter has its keyframes (N, 7); `count` particles draw.

    Poses are those of the images as they are, and draws are given these; what an unknown field may have moved
    them by is in their covariances.
    """
    keyframes, found = optimise_coarse_to_fine(images, filtered, motion)
    graph = found and with_distortion(keyframes, found, unknown, motion)
    if found is None or graph is None:
        return _unrefined(filtered, unknown, scales, count)
    field = _estimated_field(keyframes, found, unknown, scales, motion)
    return _Mode(
        poses=found.poses,
        covariances=sparse_gaussian.conditional_marginals(graph),
        held=sparse_gaussian.connected_to_first(graph),
        sensitivity=field.scale * sparse_gaussian.field_posterior(graph).sensitivity,
        **_told_of(field, unknown.factor),
        drawn=draw_poses(found.poses, sparse_gaussian.draws(key, graph, count)),
    )


def _estimated_field(
    keyframes: Keyframes,
    start: GraphOptimum,
    unknown: Distortion,
    scales: Sequence[float],
    motion: TrajectoryPrior | None,
) -> ScaledField:
    """The field at the joint optimum with the poses, of the first `FIELD_KEYFRAMES`.

    Twice: planes that were fitted to distorted depths do not bend with the field. The first time few samples
    do, since all are looked at again.
    """
    keyframes, start = keyframes.first(FIELD_KEYFRAMES), start.first(FIELD_KEYFRAMES)
    found = optimise_with_distortion(keyframes, start, unknown, motion, stride=THINNED)
    if found is not None:
        corrected = keyframes.corrected(jnp.asarray(found.distortion.disparity_per_m, jnp.float32))
        removed = found.distortion.removed()
        found = optimise_with_distortion(corrected, found, removed, motion, inflations=())
    if found is None:
        return unseen_field(unknown.factor.shape[1], scales)
    return scaled_field(sparse_gaussian.field_posterior(found.graph), found.distortion.coordinates, scales)


def _told_of(field: ScaledField, factor: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """The field's prior, as strong as it turned out, and its nodes (NODES,), by names of a `_Mode`."""
    variance = np.einsum("nf,fg,ng->n", factor, field.covariance, factor)
    return {
        "factor": field.scale * factor,
        "disparity_per_m": factor @ field.mean,
        "sd_per_m": np.sqrt(variance),
    }


def _unrefined(poses: NDArray[np.float32], unknown: Distortion, scales: Sequence[float], count: int) -> _Mode:
    """A mode (N, 7) whose keyframes nothing ties to the first: the field is what it was a priori."""
    used, size = len(poses), unknown.factor.shape[1]
    return _Mode(
        poses=poses,
        covariances=np.zeros((used, 6, 6)),
        held=np.arange(used) == 0,
        sensitivity=np.zeros((used, 6, size)),
        **_told_of(unseen_field(size, scales), unknown.factor),
        drawn=np.tile(poses, (count, 1, 1)),
    )
