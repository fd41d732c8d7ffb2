"""Joint refinement of all keyframes: the optimum of their overlaps, and its Laplace approximation.

The filter places a keyframe once, at working resolution; errors accumulate along the path. Here every
keyframe's image at full detail is compared with the surfaces of all keyframes that it overlaps, and the graph
of overlaps is brought to its optimum (`slam.pose_graph.gauss_newton`), from each of the maps that are left.
Trajectories are drawn from the graph's Gaussian there, the Laplace approximation of the overlaps' density
(docs/model.md, section J), as many of each map as it is probable. The sensor's distortion field is an error
that all frames share, which no number of them averages out: poses follow it, and its prior is in what is told
of them (a consider parameter; Schmidt 1966), scaled to what the recording tells of it
(`slam.pose_graph.distortion_scale`). It is estimated jointly with the poses for the sensor's profile, by
which frames may be corrected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from slam.filter import smc
from slam.filter.state import Hypothesis
from slam.likelihood.distortion import Distortion
from slam.pose_graph import sparse_gaussian
from slam.pose_graph.coarse_to_fine import optimise_coarse_to_fine
from slam.pose_graph.displacements import draw_poses
from slam.pose_graph.distortion_scale import ScaledField, scaled_field, unseen_field
from slam.pose_graph.gauss_newton import (
    GraphOptimum,
    optimise_with_distortion,
    with_distortion,
)
from slam.pose_graph.linearisation import THINNED
from slam.pose_graph.overlaps import KeyframeImages, Keyframes
from slam.pose_graph.trajectory_prior import TrajectoryPrior

GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0

FIELD_KEYFRAMES = 200
"""Search effort: an hour's film has thousands, and the field has 62 coordinates."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class PlacedKeyframes:
    """Keyframes of G maps, looked up in tables of indices (G, ...); leaves as in `RefinedKeyframes`.

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

    @classmethod
    def stacked(cls, refined: RefinedKeyframes, keyframes: NDArray[np.integer]) -> PlacedKeyframes:
        """Those that the table (G, ...) names."""
        of_map = np.arange(len(keyframes)).reshape(-1, *[1] * (keyframes.ndim - 1)), keyframes
        return cls(
            poses=jnp.asarray(refined.poses[of_map]),
            covariances=jnp.asarray(refined.covariances[of_map], jnp.float32),
            held=jnp.asarray(refined.held[of_map]),
            sensitivity=jnp.asarray(refined.sensitivity[of_map], jnp.float32),
        )


@dataclass(frozen=True, kw_only=True)
class MapMixture:
    """Maps that are left.

    Attributes:
        poses: (G, N, 7) reference_from_keyframe.
        probabilities: (G,), given that the true one is among them.
        hypotheses: (G,) which of the filter's last ones has the frames between the keyframes.
        known: for each map the pairs (E, 2) of keyframes that are known to see the same; None where they have
            been placed by search.
        undiscovered: probability that the true map was not found.
        unseen_step: (6, 6) second moment of a step from keyframe to keyframe in such a map, of which only the
            motion prior tells.
    """

    poses: NDArray[np.float32]
    probabilities: NDArray[np.float64]
    hypotheses: NDArray[np.int_]
    known: tuple[NDArray[np.int32] | None, ...]
    undiscovered: float = 0.0
    unseen_step: NDArray[np.float64] = field(default_factory=lambda: np.zeros((6, 6)))

    @classmethod
    def of(cls, population: smc.Population[Hypothesis]) -> MapMixture:
        """As the filter has them."""
        poses = np.stack([one.keyframe_poses for one in population.histories])
        return cls(
            poses=poses,
            probabilities=population.probabilities,
            hypotheses=np.arange(len(population)),
            known=tuple(one.overlaps for one in population.histories),
        )


@dataclass(frozen=True, kw_only=True)
class RefinedKeyframes:
    """The keyframes of G maps, K draws of them, and the distortion field; without (G,) of one.

    The field's coordinates are independent unit Gaussians a priori; nodes are `factor` times coordinates.

    Attributes:
        poses: (G, N, 7) reference_from_keyframe.
        covariances: (G, N, 6, 6) in the charts there, given the field.
        held: (G, N) keyframes that overlaps tie to the first; the others are where the filter has them.
        sensitivity: (G, N, 6, F) how keyframes follow the field's coordinates.
        factor: (G, NODES, F), as strong as the recording tells.
        disparity_per_m: (G, NODES) the field's mean, as it is estimated jointly with the poses.
        sd_per_m: (G, NODES) its standard deviations.
        drawn: (K, N, 7).
        mode: (K,) the map that each draw is of.
    """

    poses: NDArray[np.float32]
    covariances: NDArray[np.float64]
    held: NDArray[np.bool_]
    sensitivity: NDArray[np.float64]
    factor: NDArray[np.float64]
    disparity_per_m: NDArray[np.float64]
    sd_per_m: NDArray[np.float64]
    drawn: NDArray[np.float32]
    mode: NDArray[np.int_]


def refine_keyframes(
    key: jax.Array,
    images: KeyframeImages,
    maps: MapMixture,
    count: int,
    sd_per_m: NDArray[np.float64],
    motion: TrajectoryPrior | None = None,
    scales: Sequence[float] = (1.0,),
) -> RefinedKeyframes:
    """Every map at its optimum, and `count` draws of them, none of which depends on how many follow.

    Args:
        key: consumed.
        images: of the keyframes.
        maps: that are left.
        count: K.
        sd_per_m: (rows, columns) deviations of the distortion field's nodes, a priori.
        motion: prior of the keyframes' poses, where it is to have a say.
        scales: factors of `sd_per_m`, equally likely.
    """
    deal_key, draw_key = jax.random.split(key)
    mode_of = dealt(deal_key, maps.probabilities, count)
    unknown = Distortion.unknown(sd_per_m)
    modes = [
        _refined(
            jax.random.fold_in(draw_key, mode),
            # no loop was looked for in a map that was placed by search
            replace(images, known=known, first_new=1 if known is None else images.first_new),
            poses,
            unknown,
            scales,
            motion,
            count,
        )
        for mode, (poses, known) in enumerate(zip(maps.poses, maps.known, strict=True))
    ]
    told = ("poses", "covariances", "held", "sensitivity", "factor", "disparity_per_m", "sd_per_m")
    return RefinedKeyframes(
        **{name: np.stack([getattr(mode, name) for mode in modes]) for name in told},
        mode=mode_of,
        drawn=np.stack([modes[mode].drawn[number] for number, mode in enumerate(mode_of)]),
    )


def dealt(key: jax.Array, probabilities: NDArray[np.float64], count: int) -> NDArray[np.int_]:
    """Of which of some modes (G,) each of `count` draws is: as often as they are probable, nearly evenly.

    Each mark is uniform; multiples of the golden ratio fill the circle evenly however many there are (Weyl).
    """
    marks = (float(jax.random.uniform(key)) + GOLDEN * np.arange(count)) % 1.0
    found = np.searchsorted(np.cumsum(probabilities), marks, side="right")
    return np.minimum(found, np.flatnonzero(probabilities)[-1])


def _refined(
    key: jax.Array,
    images: KeyframeImages,
    filtered: NDArray[np.float32],
    unknown: Distortion,
    scales: Sequence[float],
    motion: TrajectoryPrior | None,
    count: int,
) -> RefinedKeyframes:
    """One map, refined from where the filter has its keyframes (N, 7), and draws.

    Poses are those of the images as they are, and draws are given these; what an unknown field may have moved
    them by is in their covariances.
    """
    keyframes, found, _ = optimise_coarse_to_fine(images, filtered, motion)
    graph = found and with_distortion(keyframes, found, unknown, motion)
    if found is None or graph is None:
        return _unrefined(filtered, unknown, scales, count)
    drawn = draw_poses(found.poses, sparse_gaussian.draws(key, graph, count))
    if not np.isfinite(drawn).all():  # a map so wrong that its overlaps leave the numbers
        return _unrefined(filtered, unknown, scales, count)
    field = _estimated_field(keyframes, found, unknown, scales, motion)
    held = sparse_gaussian.connected_to_first(graph)
    return RefinedKeyframes(
        poses=np.where(held[:, None], found.poses, filtered),
        covariances=np.where(held[:, None, None], sparse_gaussian.conditional_marginals(graph), 0.0),
        held=held,
        sensitivity=np.where(
            held[:, None, None], field.scale * sparse_gaussian.field_posterior(graph).sensitivity, 0.0
        ),
        **_told_of(field, unknown.factor),
        drawn=np.where(held[:, None], drawn, filtered),
        mode=np.zeros(count, int),
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
    """The field's prior, as strong as it turned out, and nodes (NODES,), by names of `RefinedKeyframes`."""
    variance = np.einsum("nf,fg,ng->n", factor, field.covariance, factor)
    return {
        "factor": field.scale * factor,
        "disparity_per_m": factor @ field.mean,
        "sd_per_m": np.sqrt(variance),
    }


def _unrefined(
    poses: NDArray[np.float32], unknown: Distortion, scales: Sequence[float], count: int
) -> RefinedKeyframes:
    """A map (N, 7) whose keyframes nothing ties to the first: the field is what it was a priori."""
    used, size = len(poses), unknown.factor.shape[1]
    return RefinedKeyframes(
        poses=poses,
        covariances=np.zeros((used, 6, 6)),
        held=np.arange(used) == 0,
        sensitivity=np.zeros((used, 6, size)),
        **_told_of(unseen_field(size, scales), unknown.factor),
        drawn=np.tile(poses, (count, 1, 1)),
        mode=np.zeros(count, int),
    )
