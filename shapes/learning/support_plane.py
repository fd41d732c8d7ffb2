"""The plane on which an object stands, found in a cloud by RANSAC (Fischler and Bolles 1981)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

INLIER_M = 0.006
"""Four sigma of the default sensor noise at 0.7 m."""
TRIALS = 400
"""RANSAC: a plane with a quarter of the points is missed once in 500 runs."""
MOST_PLANES = 6
"""Search effort."""
FEWEST_INLIERS = 40
"""A smaller plane supports nothing."""
CAMERA_CLEARANCE_M = 0.05
"""A support plane does not pass through a camera."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Plane:
    """Points x with normal . x = offset_m; the cameras are on the side to which the normal points.

    Attributes:
        normal: (3,) unit.
        offset_m: along the normal.
    """

    normal: NDArray[np.float64]
    offset_m: float

    def heights(self, points_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Signed distances (...,) of points (..., 3), positive towards the cameras."""
        return points_m @ self.normal - self.offset_m


def planes_below(
    points_m: NDArray[np.float64], eyes_m: NDArray[np.float64], rng: np.random.Generator
) -> Iterator[Plane]:
    """Planes of a cloud (N, 3) with all cameras (T, 3) on one side, largest first.

    Args:
        points_m: evenly sampled.
        eyes_m: places of the cameras.
        rng: draws the trials.
    """
    left = points_m
    for _ in range(MOST_PLANES):
        if len(left) < FEWEST_INLIERS:
            return
        plane = _largest_plane(left, rng)
        inliers = np.abs(plane.heights(left)) < INLIER_M
        if inliers.sum() < FEWEST_INLIERS:
            return
        plane = fit_plane(left[inliers], eyes_m)
        if plane.heights(eyes_m).min() > CAMERA_CLEARANCE_M:
            yield plane
        left = left[~inliers]


def fit_plane(points_m: NDArray[np.float64], eyes_m: NDArray[np.float64]) -> Plane:
    """Least-squares plane of points (N, 3), its normal towards the cameras."""
    centre = points_m.mean(axis=0)
    normal = np.linalg.svd(points_m - centre, full_matrices=False)[2][2]
    if np.median((eyes_m - centre) @ normal) < 0:
        normal = -normal
    return Plane(normal=normal, offset_m=float(normal @ centre))


def _largest_plane(points_m: NDArray[np.float64], rng: np.random.Generator) -> Plane:
    corners = points_m[rng.integers(len(points_m), size=(TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    spread = lengths > 1e-6
    normals = normals[spread] / lengths[spread, None]
    offsets = (normals * corners[spread, 0]).sum(axis=1)
    sample = points_m[rng.permutation(len(points_m))[:4000]]
    if len(normals) == 0:
        return Plane(normal=np.array([0.0, 0.0, 1.0]), offset_m=np.inf)
    counts = (np.abs(sample @ normals.T - offsets) < INLIER_M).sum(axis=0)
    best = int(counts.argmax())
    return Plane(normal=normals[best], offset_m=float(offsets[best]))
