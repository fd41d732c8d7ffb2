"""Errors of estimated object poses, as the pose benchmarks define them (docs/model.md, sections D to H)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

MISSING_M = 1.0
"""Error of an object that was not found."""
THRESHOLDS_M = (0.005, 0.01, 0.02)
LARGEST_M = 0.1
"""To which the area under the curve of accuracy is taken (PoseCNN, section V)."""
MODEL_POINTS = 20_000
"""So many that turning a symmetric object of everyday size about its axis adds under a millimetre."""


def model_points(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Points (N, 3) spread over a surface by area, the same ones at each call."""
    return np.asarray(trimesh.sample.sample_surface(mesh, MODEL_POINTS, seed=0)[0], np.float64)


def add_s_m(
    points_m: NDArray[np.float64], truth: NDArray[np.float64], estimate: NDArray[np.float64] | None
) -> float:
    """ADD-S of a pose estimate: symmetric objects are judged by where their surface lies.

    Mean over model points at the true pose of the distance to the nearest model point at the estimated
    pose (Xiang et al. 2018, PoseCNN, section IV-A).

    Args:
        points_m: (N, 3) in the object's frame.
        truth: (4, 4) pose of the object.
        estimate: (4, 4) in the same frame as `truth`; None where the object was not found.
    """
    if estimate is None:
        return MISSING_M
    nearest, _ = KDTree(trimesh.transform_points(points_m, estimate)).query(
        trimesh.transform_points(points_m, truth)
    )
    return float(nearest.mean())


def accuracy(errors_m: ArrayLike, threshold_m: float) -> float:
    """Share of errors under a threshold, strictly, as the supplement counts them."""
    return float((np.asarray(errors_m) < threshold_m).mean())


def area_under_accuracy(errors_m: ArrayLike) -> float:
    """Area under the curve of accuracy over thresholds from 0 to `LARGEST_M`, as a share of the whole.

    Exact: each error e adds the thresholds above it, 1 - e / largest.
    """
    return float(np.clip(1 - np.asarray(errors_m) / LARGEST_M, 0, 1).mean())


def error_figures(errors_m: Sequence[float]) -> dict[str, Any]:
    """The figures by which a set of errors is judged."""
    return {
        "median_m": float(np.median(errors_m)),
        "largest_m": float(np.max(errors_m)),
        "accuracy": {f"{threshold:g}": accuracy(errors_m, threshold) for threshold in THRESHOLDS_M},
        "auc_0_10cm": area_under_accuracy(errors_m),
    }


def best_matches(error_m: NDArray[np.float64]) -> Sequence[tuple[int, int]]:
    """Pairs of (true, estimated) instances of one shape with the least sum of errors (T, E)."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(error_m)
    return list(zip(rows.tolist(), columns.tolist(), strict=True))
