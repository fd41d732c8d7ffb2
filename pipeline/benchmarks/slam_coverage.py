"""How often the truth lies inside the regions that slam states: one random frame of each of many short runs.

Frames of one run share their errors, so that only one of each counts; runs differ in room, path and noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pipeline.benchmarks.slam_cases import Case, short_walk
from pipeline.evaluation.trajectory_errors import LEVELS, level_of, squared_distances
from pipeline.progress import Report
from slam.config import SlamConfig
from slam.tracking import track

ROW = "coverage, short runs"
FAR_OFF_M = 0.1
"""No short walk's frame should be farther off than that without being told as lost."""
INTERVAL = 0.999
"""Of the binomial interval of each share."""


def coverage_row(
    runs: int, seed: int, report: Report, case: Callable[[int], Case] = short_walk
) -> dict[str, Any]:
    """The row of the table: shares inside the regions of 50, 90 and 95%, with their intervals.

    Args:
        runs: short recordings, of one random frame each.
        seed: of the first.
        report: is told how many of how many are done.
        case: the recording of a number.
    """
    levels, errors_m = [], []
    for run in range(runs):
        level, untold_m = _level(case, seed * 10_000 + run)
        levels.append(level)
        errors_m.append(untold_m)
        report(run + 1, runs)
    return {
        "row": ROW,
        "unit": "share of true poses inside",
        "runs": runs,
        **summary(np.asarray(levels)),
        "median_worst_m": float(np.median(errors_m)),
        "far_off_untold": int((np.asarray(errors_m) > FAR_OFF_M).sum()),
    }


def _level(case: Callable[[int], Case], number: int) -> tuple[float, float]:
    """The level of the region on whose edge the true pose of one random frame lies; the worst error, metres.

    The worst of the frames that are not told as lost.
    """
    recording = case(number)
    result = track(jax.random.key(number), recording.frames, recording.intrinsics, SlamConfig())
    frame = int(np.random.default_rng([number, 2]).integers(1, len(result)))
    chosen = slice(frame, frame + 1)
    squared = squared_distances(result.mean[chosen], result.covariance[chosen], recording.poses[chosen])
    errors_m = np.linalg.norm(result.mean[:, :3, 3] - recording.poses[:, :3, 3], axis=1)
    level = level_of(float(squared[0]), float(result.degrees_of_freedom))
    return level, float(errors_m[~result.lost].max())


def summary(levels_of_truth: NDArray[np.float64] | Sequence[float]) -> dict[str, Any]:
    """Shares of true poses inside regions, given the levels (n,) of those on whose edge they lie."""
    levels_of_truth = np.asarray(levels_of_truth)
    levels = {}
    for level in LEVELS:
        inside = int((levels_of_truth <= level).sum())
        interval = stats.binomtest(inside, len(levels_of_truth)).proportion_ci(INTERVAL, method="exact")
        levels[f"{level:.2f}"] = {
            "share": inside / len(levels_of_truth),
            "least": float(interval.low),
            "most": float(interval.high),
            "holds": bool(interval.low <= level <= interval.high),
        }
    return {"coverage": levels, "median_level": float(np.median(levels_of_truth))}
