"""The lines about which half or quarter of a turn leaves an object's surface nearly as it is.

A box of which only two faces are seen stands as well the other way round, but not in the same place: its
middle is not the bounding box's to the tenth of a millimetre that depth images tell. Each line is that of
least squares: the surface, turned, is laid on itself (iterated closest points, to planes), with weights that
leave out what the turn does not repeat.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

NEAR_M = 0.003
"""Distance up to which a turned point counts as on the surface, and at which its weight falls."""
MOSTLY = 0.8
"""Share of the points that are, where there is such a line."""
SQUARE = 0.15
"""Relative difference of two extents up to which a quarter of a turn is tried."""
ROUNDS = 6
TURNED = 512
"""Points that are laid on the surface."""


def symmetry_lines(
    points: NDArray[np.float64], normals: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int_]]:
    """Directions and points (3, 2, 3) of the lines, and their orders (3,): 4, 2, or 0 where there is none.

    The axes of the least bounding box are tried.

    Args:
        points: (P, 3) many of a surface, in random order, in metres.
        normals: (P, 3).
    """
    to_box, extents = trimesh.bounds.oriented_bounds(points)
    axes = to_box[:3, :3]
    tree = KDTree(points)
    lines, orders = np.zeros((3, 2, 3)), np.zeros(3, int)
    for number, axis in enumerate(axes):
        across = np.delete(extents, number)
        for order in (4, 2) if np.ptp(across) < SQUARE * across.max() else (2,):
            line, share = _fitted(tree, points, normals, axis, 2 * np.pi / order)
            if share > MOSTLY:
                lines[number], orders[number] = line, order
                break
    return lines, orders


def _fitted(
    tree: KDTree,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    axis: NDArray[np.float64],
    angle: float,
) -> tuple[NDArray[np.float64], float]:
    """The line (2, 3) next to an axis through the middle, and the share of points that its turn repeats."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    line = np.stack([axis, middle])
    for _ in range(ROUNDS):
        turned, across, gaps = _laid(tree, points, normals, line, angle)
        weights = 1 / (1 + (gaps / NEAR_M) ** 2) ** 2
        design = np.concatenate([np.cross(turned - line[1], across), across], axis=1)
        square = design.T @ (weights[:, None] * design)
        square += 1e-6 * np.trace(square) / 6 * np.eye(6)
        step = -np.linalg.solve(square, design.T @ (weights * gaps))
        line = _line_of(
            Rotation.from_rotvec(step[:3]) * Rotation.from_rotvec(angle * line[0]), step[3:], line
        )
    gaps = _laid(tree, points, normals, line, angle)[2]
    return line, float((np.abs(gaps) < NEAR_M).mean())


def _laid(
    tree: KDTree,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    line: NDArray[np.float64],
    angle: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The first points (T, 3) turned about a line, the normals next to them, and metres over the surface."""
    turned = Rotation.from_rotvec(angle * line[0]).apply(points[:TURNED] - line[1]) + line[1]
    nearest = tree.query(turned)[1]
    across = normals[nearest]
    return turned, across, ((turned - points[nearest]) * across).sum(axis=1)


def _line_of(turn: Rotation, shift: NDArray[np.float64], before: NDArray[np.float64]) -> NDArray[np.float64]:
    """The line (2, 3) of a turn about a point of the line before, shifted then, but for its slide."""
    vector = turn.as_rotvec()
    direction = vector / np.linalg.norm(vector)
    direction *= np.sign(direction @ before[0])
    across = shift - shift @ direction * direction
    moved = np.linalg.lstsq(np.eye(3) - turn.as_matrix(), across, rcond=None)[0]
    return np.stack([direction, before[1] + moved])
