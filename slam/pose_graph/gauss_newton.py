"""Gauss-Newton optimum of the keyframe overlap graph; every overlap is linearised anew in each round.

The target is the overlap density (`slam.likelihood.overlap_density`), tempered so that a pixel explained by
several surfaces counts once; in the last rounds it is a density of the sensor's distortion field, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from shapes.geometry.poses import matrices_of
from slam.likelihood.distortion import Distortion
from slam.pose_graph import sparse_gaussian
from slam.pose_graph.displacements import coordinates, displaced
from slam.pose_graph.linearisation import Field, Linearised, exponents_of, linearised_at
from slam.pose_graph.overlaps import Keyframes
from slam.pose_graph.sparse_gaussian import PoseGraph
from slam.pose_graph.trajectory_prior import TrajectoryPrior
from slam.registration.registered import CONVINCING_EXPLAINED

INFLATIONS = (4.0, 3.0, 2.0, 1.5)
"""Of sigma in the first rounds, which start at the filter's drift."""

MOST_STEPS = 8
"""After those."""

DAMPING = 1e4
"""A step of a centimetre along what no pixel sees weighs as much as one standard deviation."""

STEP_SHARES = (1.0, 0.5, 0.25, 0.125)
"""Of a step, where the density is asked."""

CONVERGED = 0.05
"""Gain of a step, in tempered nats, as a share of what noise itself costs at the optimum: half a nat for each
coordinate. In a bare room further steps lead away, centimetres along the walls, for nothing (measured)."""

HELD_INFLATIONS, HELD_DAMPING, HELD_CONVERGED = (1.0,), 100.0, 0.002
"""The same where the motion prior holds what no pixel sees (without inflation also where steps are to lead
uphill: the density is that of sigma itself). It is not to outweigh what they see: few samples of inflated
sigma say less of rotations than it does, so that all are asked from the first round on."""

FIELD_INFLATIONS = (3.0, 2.0, 1.5)
"""Of sigma in the first rounds with the distortion field: a gap may be as wide as the field bends it."""

FARTHEST = 0.05
"""Metres or radians. A keyframe that would move farther is not near its optimum: the filter drifted or
mistook the place, or nothing holds it. It stays, and the others are refined without it."""


@dataclass(frozen=True, kw_only=True)
class GraphOptimum:
    """Where the keyframes agree best.

    Attributes:
        poses: (N, 7) reference_from_keyframe.
        graph: tempered, there.
        exponents: (N,) of each image's densities.
        astray: (N,) keyframes that were left where they were.
    """

    poses: NDArray[np.float32]
    graph: PoseGraph
    exponents: NDArray[np.float64]
    astray: NDArray[np.bool_]

    def first(self, count: int) -> GraphOptimum:
        """As a start for the first so many keyframes alone."""
        some = slice(count)
        poses, exponents, astray = self.poses[some], self.exponents[some], self.astray[some]
        return replace(self, poses=poses, exponents=exponents, astray=astray)


@dataclass(frozen=True, kw_only=True)
class FieldOptimum(GraphOptimum):
    """The same with the sensor's distortion field.

    Attributes:
        distortion: there.
    """

    distortion: Distortion


def optimise(
    keyframes: Keyframes,
    poses: NDArray[np.float32],
    inflations: Sequence[float] = INFLATIONS,
    farthest: float = FARTHEST,
    motion: TrajectoryPrior | None = None,
    damping: float = DAMPING,
    *,
    uphill: bool = False,
) -> GraphOptimum | None:
    """The optimum near poses (N, 7), for a sensor without distortion.

    None where no keyframes overlap. `inflations` and `farthest` as `INFLATIONS` and `FARTHEST`; with `motion`
    the overlaps are tempered in every step, and damped less: it holds what they do not see. Steps are taken
    as far as they lead `uphill`: others are not asked, which is quicker, and where a view leaves a direction
    nearly free they may slide along it, downhill, on gaps of a field's size.
    """
    start, astray = poses, np.zeros(len(poses), bool)
    linearised = linearised_at(keyframes, poses, inflations[0], astray)
    converged = CONVERGED if motion is None else HELD_CONVERGED
    damping = damping if motion is None else HELD_DAMPING
    for round_ in range(1, len(inflations) + MOST_STEPS):
        if linearised is None:
            return None
        tempered = _tempered(linearised, exponents_of(linearised), motion, poses)
        step, none = sparse_gaussian.damped_step(linearised.graph if motion is None else tempered, damping)
        least = converged * 0.5 * step[keyframes.fixed :].size
        if round_ > len(inflations) and _gain(tempered, step, none) < least:
            break
        before, poses = poses, displaced(poses, step)
        if uphill:
            poses = _best_of_step(keyframes, before, step, exponents_of(linearised), motion)
        if np.array_equal(poses, before):
            break
        astray |= np.abs(coordinates(start, poses)).max(axis=1) > farthest
        poses = np.where(astray[:, None], start, poses)
        inflation = inflations[round_] if round_ < len(inflations) else 1.0
        linearised = linearised_at(keyframes, poses, inflation, astray)
    if linearised is None:
        return None
    exponents = exponents_of(linearised)
    graph = _tempered(linearised, exponents, motion, poses)
    return GraphOptimum(poses=poses, graph=graph, exponents=exponents, astray=astray)


def agreement(keyframes: Keyframes, poses: NDArray[np.float32]) -> PoseGraph | None:
    """The tempered graph at poses (N, 7) of overlaps whose pixels agree there; None without any overlap.

    Of others, as between views of a floor that are taken for each other, each keyframe has the best one with
    an earlier one alone: it was placed by that.
    """
    linearised = linearised_at(keyframes, poses, 1.0, np.zeros(len(poses), bool), told=True)
    if linearised is None:
        return None
    graph = _tempered(linearised, exponents_of(linearised), None, poses)
    share = linearised.inliers / np.maximum(linearised.meeting, 1.0)
    best = np.zeros(len(poses))
    np.maximum.at(best, graph.pairs.max(axis=1), share)
    agree = share >= np.minimum(best[graph.pairs.max(axis=1)], CONVINCING_EXPLAINED)
    return replace(
        graph, pairs=graph.pairs[agree], precision=graph.precision[agree], gradient=graph.gradient[agree]
    )


def with_distortion(
    keyframes: Keyframes,
    start: GraphOptimum,
    distortion: Distortion,
    motion: TrajectoryPrior | None = None,
) -> PoseGraph | None:
    """The tempered graph at an optimum, with how its terms depend on the sensor's distortion field.

    None where no keyframes overlap.
    """
    field = Field(distortion=distortion, exponents=start.exponents)
    linearised = linearised_at(keyframes, start.poses, 1.0, start.astray, field, told=True)
    return None if linearised is None else _tempered(linearised, start.exponents, motion, start.poses)


def optimise_with_distortion(
    keyframes: Keyframes,
    start: GraphOptimum,
    distortion: Distortion,
    motion: TrajectoryPrior | None = None,
    inflations: Sequence[float] = FIELD_INFLATIONS,
    stride: int = 1,
) -> FieldOptimum | None:
    """The optimum over poses and the sensor's distortion field, from one without it.

    Terms are tempered in every step, by the exponents of the one before, for the field's prior is to be worth
    as much as they. `inflations` as
    `FIELD_INFLATIONS`, none where the start is an optimum already; every `stride`-th sample counts.
    """
    poses, exponents, rounds = start.poses, start.exponents, len(inflations) + MOST_STEPS
    for round_ in range(rounds):
        inflation = inflations[round_] if round_ < len(inflations) else 1.0
        field = Field(distortion=distortion, exponents=exponents)
        linearised = linearised_at(keyframes, poses, inflation, start.astray, field, stride)
        if linearised is None:
            return None
        tempered = _tempered(linearised, exponents, motion, poses)
        exponents = exponents_of(linearised)
        step, of_field = sparse_gaussian.damped_step(tempered, HELD_DAMPING)
        gain = _gain(tempered, step, of_field)
        least = HELD_CONVERGED * 0.5 * (step[keyframes.fixed :].size + of_field.size)
        if round_ == rounds - 1 or (inflation == 1.0 and gain < least):
            return FieldOptimum(
                poses=poses, graph=tempered, exponents=exponents, astray=start.astray, distortion=distortion
            )
        poses, distortion = displaced(poses, step), distortion.moved(of_field)
    return None


def _tempered(
    linearised: Linearised,
    exponents: NDArray[np.float64],
    motion: TrajectoryPrior | None,
    poses: NDArray[np.float32],
) -> PoseGraph:
    """The graph with terms to the power of their images' exponents (N,), and the prior at poses (N, 7)."""
    graph = linearised.graph
    of_terms = exponents[graph.pairs[:, 0]]
    return replace(
        graph,
        precision=graph.precision * of_terms[:, None, None],
        gradient=graph.gradient * of_terms[:, None],
        joint=None if motion is None else motion.bent(matrices_of(poses)),
    )


def _best_of_step(
    keyframes: Keyframes,
    poses: NDArray[np.float32],
    step: NDArray[np.float64],
    exponents: NDArray[np.float64],
    motion: TrajectoryPrior | None,
) -> NDArray[np.float32]:
    """Where the density is greatest along a step (N, 6) from poses (N, 7), which may be there."""
    along = np.stack([poses, *(displaced(poses, share * step) for share in STEP_SHARES)])
    log_densities = keyframes.log_densities(along, exponents)
    if motion is not None:
        log_densities += [motion.log_density(matrices_of(each)) for each in along]
    return along[int(np.argmax(log_densities))]


def _gain(graph: PoseGraph, step: NDArray[np.float64], of_field: NDArray[np.float64]) -> float:
    """Nats by which a Newton step (N, 6) and (F,) raises the density: half its squared decrement."""
    displaced = step[graph.pairs].reshape(-1, 12)
    squared = np.einsum("ei,eij,ej->", displaced, graph.precision, displaced)
    if graph.joint is not None:
        squared += step.ravel() @ graph.joint.precision @ step.ravel()
    if graph.field is not None:
        squared += of_field @ (graph.field.precision @ of_field + 2.0 * graph.field.cross.T @ step.ravel())
    return float(0.5 * squared)
