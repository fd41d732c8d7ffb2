"""The line about which most of an object's surface is round: a can's axis, and a mug's for all its handle.

Of a turn about a line with direction a, through p, a point x of the surface moves along a x (x - p). The
surface is round where that is across the normal n: n . (a x (x - p)) = 0 is linear in (a, -a x p), and the
line of least squares the eigenvector of a 3 x 3 matrix (Pottmann and Wallner 2001, Computational Line
Geometry, chapter 6). Weights that fall with the angle between motion and surface leave out the handle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MOSTLY = 0.7
"""Share of the points at the sides that are round, where an object has such a line."""
ROUND = 0.15
"""Sine of the angle between motion and surface up to which a point counts, and at which its weight falls."""
SIDE = 0.5
"""Sine of the angle between a normal and the line from which on a point tells of the line."""
TURNS = 12
NEAR_M = 0.005
"""Points nearer to the line have no more leverage than at that distance."""
LEAST = 1e-3
"""Of the mean curvature that holds the line where nothing tells: along itself."""


def spin_line(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Direction and point (2, 3) of the line about which most of a surface is round; zeros without one.

    Args:
        points: (P, 3) well spread, in metres.
        normals: (P, 3).
    """
    lines = [_fitted(points, normals, axis) for axis in np.eye(3)]
    shares = [_share(points, normals, line) for line in lines]
    best = int(np.argmax(shares))
    return lines[best] if shares[best] > MOSTLY else np.zeros((2, 3))


def _fitted(
    points: NDArray[np.float64], normals: NDArray[np.float64], start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The line (2, 3) of least squares, reweighted, from a box axis."""
    line = np.stack([start, np.zeros(3)])
    moments = np.cross(points, normals)
    for _ in range(TURNS):
        sines, sides, reach = _against(points, normals, line)
        weights = np.where(sides > SIDE, 1.0, 0.0) / (1 + (sines / ROUND) ** 2) ** 2
        weights /= np.maximum(reach, NEAR_M) ** 2
        turn, shift = weights[:, None] * moments, weights[:, None] * normals
        hold = shift.T @ normals
        hold += LEAST * np.trace(hold) / 3 * np.eye(3) + np.finfo(float).tiny * np.eye(3)
        velocity = -np.linalg.solve(hold, shift.T @ moments)
        direction = np.linalg.eigh(turn.T @ moments + turn.T @ normals @ velocity)[1][:, 0]
        line = np.stack([direction, np.cross(direction, velocity @ direction)])
    return line


def _share(points: NDArray[np.float64], normals: NDArray[np.float64], line: NDArray[np.float64]) -> float:
    """Of the points at the sides, that are round about the line."""
    sines, sides, _ = _against(points, normals, line)
    return float((sines < ROUND)[sides > SIDE].mean()) if (sides > SIDE).any() else 0.0


def _against(
    points: NDArray[np.float64], normals: NDArray[np.float64], line: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Sines between motion and surface and between normal and line, and metres from the line, each (P,)."""
    motion = np.cross(line[0], points - line[1])
    reach = np.linalg.norm(motion, axis=1)
    sides = np.linalg.norm(np.cross(line[0], normals), axis=1)
    sines = np.abs((motion * normals).sum(axis=1)) / np.maximum(reach * sides, 1e-9)
    return sines, sides, reach
