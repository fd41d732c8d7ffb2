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
from slam.config import SlamConfig
from slam.tracking import track
from slam.trajectory_errors import coverage, squared_distances

ROW = "coverage, short runs"
INTERVAL = 0.999
"""Of the binomial interval of each share."""


def coverage_row(
    runs: int, seed: int, report: Callable[[int, int | None], None], case: Callable[[int], Case] = short_walk
) -> dict[str, Any]:
    """The row of the table: shares inside the regions of 50, 90 and 95%, with their intervals.

    Args:
        runs: short recordings, of one random frame each.
        seed: of the first.
        report: is told how many of how many are done.
        case: the recording of a number.
    """
    squared = []
    for run in range(runs):
        squared.append(_squared_distance(case, seed * 10_000 + run))
        report(run + 1, runs)
    return {"row": ROW, "unit": "share of true poses inside", "runs": runs, **summary(np.asarray(squared))}


def _squared_distance(case: Callable[[int], Case], number: int) -> float:
    recording = case(number)
    result = track(jax.random.key(number), recording.frames, recording.intrinsics, SlamConfig())
    frame = int(np.random.default_rng([number, 2]).integers(1, len(result)))
    chosen = slice(frame, frame + 1)
    return float(
        squared_distances(result.mean[chosen], result.covariance[chosen], recording.poses[chosen])[0]
    )


def summary(squared: NDArray[np.float64] | Sequence[float]) -> dict[str, Any]:
    """Shares of squared Mahalanobis distances (n,) inside, and their median over that of chi-square."""
    squared = np.asarray(squared)
    shares = coverage(squared)
    levels = {}
    for level, share in shares.items():
        inside = round(share * len(squared))
        interval = stats.binomtest(inside, len(squared)).proportion_ci(INTERVAL, method="exact")
        levels[f"{level:.2f}"] = {
            "share": share,
            "least": float(interval.low),
            "most": float(interval.high),
            "holds": bool(interval.low <= level <= interval.high),
        }
    return {"coverage": levels, "median_ratio": float(np.median(squared) / stats.chi2.median(6))}
