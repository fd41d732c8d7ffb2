"""Where a frame may have been taken in each hypothesis: near its prediction, or anywhere in its map."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray

from shapes.geometry import pose_gaussian
from shapes.geometry.poses import matrices_of, poses_of
from slam.config import SlamConfig
from slam.filter.motion import LONGEST_RATIO, is_wide_step, velocity_ratio
from slam.filter.state import FilterState, Hypothesis
from slam.keyframes.depth_view import CanvasView, shows_enough
from slam.registration.registered import Registration, prune_improbable, suppress_duplicates
from slam.registration.search import Searcher

PREDICTION_WEIGHT = 0.01
"""`PixelTerms.held_step`'s hold at a trusted prediction."""

MAX_PLACES = 8
"""Optima by which one hypothesis branches."""


@dataclass(frozen=True)
class Prediction:
    """What the hypotheses (H,) expect of a frame.

    Attributes:
        poses: (H, 7) reference_from_camera, the last motion going on.
        trusted: whether they are worth keeping where depth tells nothing.
    """

    poses: NDArray[np.float32]
    trusted: bool


def predict(state: FilterState, time_ns: int) -> Prediction:
    """Of the frame with that stamp."""
    ratio = velocity_ratio(state.times_ns, time_ns)
    poses = [
        np.asarray(_carried_on(one.previous_pose, one.pose, ratio)) for one in state.population.histories
    ]
    return Prediction(np.stack(poses), trusted=0.0 < ratio < LONGEST_RATIO and not state.lost_frames)


@jax.jit
def _carried_on(previous: jax.Array, pose: jax.Array, ratio: float) -> jax.Array:
    return pose_gaussian.displace(pose, ratio * pose_gaussian.coordinates(previous, pose))


@dataclass(frozen=True)
class Found:
    """Where a frame may have been taken.

    Attributes:
        of_hypotheses: by hypothesis (H,) its places, the best first; empty for all where the frame is lost.
        best: the best of all; where the frame is lost, what comes nearest to one.
        unexpected: whether none was found where the camera was expected.
        contradicted: whether the frame contradicts keyframes in sight that are not at hand.
    """

    of_hypotheses: list[list[Registration]]
    best: Registration
    unexpected: bool
    contradicted: bool

    @property
    def lost(self) -> bool:
        """Whether there is no place."""
        return not any(self.of_hypotheses)


def find_places(
    state: FilterState,
    view: CanvasView,
    prediction: Prediction,
    config: SlamConfig,
    odometry: NDArray[np.float64] | None,
) -> Found:
    """The frame's places in every hypothesis.

    Where depth tells nothing of a direction, as along a bare wall, a trusted prediction is kept.

    Each hypothesis looks near its own prediction. Where none finds a convincing place, or the
    camera was lost and predictions mean little, all look where it was last found, and everywhere; after
    a wide step already where none finds an unmistakable one. A view of nothing is not searched.
    """
    hypotheses, noise = state.population.histories, state.calibration.noise
    searchers = [
        Searcher(state.keyframe_map, one.keyframe_poses, view, noise, config.keyframes_compared)
        for one in hypotheses
    ]
    found: list[list[Registration]] = [[] for _ in hypotheses]
    contradicted = False
    is_searched = shows_enough(view)
    if not state.lost_frames or not is_searched:
        hold = PREDICTION_WEIGHT if prediction.trusted else 0.0
        for index, (searcher, one) in enumerate(zip(searchers, hypotheses, strict=True)):
            starts = _starts(one, prediction.poses[index], config, odometry)
            near, contradicts = _near(searcher, one, starts, hold if len(starts) > 1 else 0.0)
            found[index].append(near)
            contradicted |= contradicts
    near = [located for of_one in found for located in of_one]
    unexpected = is_searched and not any(located.is_accepted for located in near)
    doubtful = not any(located.is_unambiguous for located in near)
    wide = is_searched and doubtful and _step_may_be_wide(state.population.heaviest)
    if unexpected or wide:
        for of_one, searcher, one in zip(found, searchers, hypotheses, strict=True):
            of_one.append(searcher.near([one.pose]))
            of_one += searcher.anywhere(one.pose)
        distinct = [suppress_duplicates(of_one) for of_one in found]
    else:
        distinct = found
    kept = [prune_improbable(of_one, state.calibration.exponent)[:MAX_PLACES] for of_one in distinct]
    places = [located for of_one in kept for located in of_one]
    best = max(places, key=lambda one: one.log_density, default=found[0][0])
    return Found(kept, best, unexpected, contradicted)


def _near(
    searcher: Searcher, hypothesis: Hypothesis, starts: list[NDArray[np.float32]], hold: float
) -> tuple[Registration, bool]:
    """The place next to the starts (7,), and whether it contradicts keyframes in sight there.

    Keyframes that are not at hand are where they are by drift, which may be negligible or not: the frame
    is the more probable with them, or without.
    """
    found, at_hand = searcher.near(starts, hold), hypothesis.at_hand
    if at_hand[found.indices].all():
        return found, False
    without = searcher.among(at_hand).near(starts, hold)
    contradicts = without.log_density > found.log_density
    return (without if contradicts else found), contradicts


def _starts(
    hypothesis: Hypothesis,
    predicted: NDArray[np.float32],
    config: SlamConfig,
    odometry: NDArray[np.float64] | None,
) -> list[NDArray[np.float32]]:
    """Poses (7,) near which a hypothesis looks, the likeliest first."""
    if odometry is None:
        return [predicted, hypothesis.pose]
    carried = poses_of(matrices_of(hypothesis.pose) @ odometry).astype(np.float32)
    return [carried] if config.proposal == "kiss" else [predicted, hypothesis.pose, carried]


def _step_may_be_wide(hypothesis: Hypothesis) -> bool:
    """Whether the next step may lead to a place that only looks like it: the last one was wide.

    Round an object on a pedestal the last view explains most of the next one, a fifth of a circle on. Of the
    first step nothing is known, nor of one after a frame that was lost.
    """
    before, after = hypothesis.previous_pose, hypothesis.pose
    return np.array_equal(before, after) or is_wide_step(before, after)
