"""Symmetry lines of objects: continuous (a can's axis), of order two and of order four (a box's).

**Continuous.** Of a rotation about a line with direction a, through p, a surface point x moves along
a x (x - p). The surface is round where that is across the normal n: n . (a x (x - p)) = 0 is linear in
(a, -a x p), and the least-squares line is the eigenvector of a 3 x 3 matrix (Pottmann and Wallner 2001,
Computational Line Geometry, chapter 6). Weights that fall with the angle between motion and surface leave out
handles.

**Order two and four.** A box of which two faces are seen fits as well the other way round, but not in the
same place: its middle is not the bounding box's to a tenth of a millimetre. Each line is the least-squares
one: the rotated surface is registered to itself (iterated closest points, to planes), with weights that leave
out what the rotation does not repeat.

**Free.** A shape spins freely where every spin about its line leaves it as it is: a can, no mug.

**Alike.** A mug whose handle was taken to be hidden may show it: a narrow mode that a coarse grid of
rotations misses. Refinement begins at all turns after which an object looks nearly the same.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from shapes.geometry.poses import transform_points

SPIN_SHARE = 0.7
"""Share of the points at the sides that are round, where an object has such a line."""

ROUND = 0.15
"""Sine of the angle between motion and surface up to which a point counts, and at which its weight falls."""

SIDE = 0.5
"""Sine of the angle between a normal and the line from which on a point tells of the line."""

TURNS = 12

SPIN_NEAR_M = 0.005
"""Points nearer to the line have no more leverage than at that distance."""

LEAST = 1e-3
"""Of the mean curvature that holds the line where nothing tells: along itself."""


def spin_line(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Direction and point (2, 3) of the line about which most of a surface is round; zeros without one.

    Args:
        points: (P, 3) well spread, in metres.
        normals: (P, 3).
    """
    lines = [_fitted_axis(points, normals, axis) for axis in np.eye(3)]
    shares = [_share(points, normals, line) for line in lines]
    best = int(np.argmax(shares))
    return lines[best] if shares[best] > SPIN_SHARE else np.zeros((2, 3))


def _fitted_axis(
    points: NDArray[np.float64], normals: NDArray[np.float64], start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The line (2, 3) of least squares, reweighted, from a box axis."""
    line = np.stack([start, np.zeros(3)])
    moments = np.cross(points, normals)
    for _ in range(TURNS):
        sines, sides, reach = _against(points, normals, line)
        weights = np.where(sides > SIDE, 1.0, 0.0) / (1 + (sines / ROUND) ** 2) ** 2
        weights /= np.maximum(reach, SPIN_NEAR_M) ** 2
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


NEAR_M = 0.003
"""Distance up to which a turned point counts as on the surface, and at which its weight falls."""

MOSTLY = 0.8
"""Share of the points that are, where there is such a line."""

SQUARE = 0.15
"""Relative difference of two extents up to which a quarter of a turn is tried."""

ROUNDS = 12
"""Of reweighting: after six a line was 0.7 mm off where a knob moves the middle of the points by 5."""

TURNED = 512
"""Points that are laid on the surface."""


def turns_about(line: NDArray[np.float64], angles: NDArray[np.floating]) -> NDArray[np.float64]:
    """Turns (A, 4, 4) by angles (A,) about a line (2, 3), unit direction and a point on it."""
    direction, point = line
    turns = np.tile(np.eye(4), (len(angles), 1, 1))
    turns[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * direction).as_matrix()
    turns[:, :3, 3] = point - turns[:, :3, :3] @ point
    return turns


def even_turns(line: NDArray[np.float64], order: int) -> NDArray[np.float64]:
    """All turns (order, 4, 4) about a line (2, 3) by parts of a full one, none first."""
    return turns_about(line, 2 * np.pi * np.arange(order) / order)


def products(parts: Iterable[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Every product (T, 4, 4) of one turn of each part, in their order, the last part's changing fastest."""
    turns = np.eye(4)[None]
    for part in parts:
        turns = (turns[:, None] @ part[None]).reshape(-1, 4, 4)
    return turns


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
            line, share = _turn_line(tree, points, normals, axis, 2 * np.pi / order)
            if share > MOSTLY:
                lines[number], orders[number] = line, order
                break
    return lines, orders


def _turn_line(
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


SPINS = 24
"""About the line of what is round: steps of 15 degrees, in which a label as wide as that still overlaps."""

ALIKE = 0.97
"""A turn leaves a shape as it is where so large a share of its surface comes to lie within NEAR_M of it: the
sensor's noise hides the rest. Mugs, of which 0.93 to 0.96 do, do not spin freely: their handles tell."""

TESTED = 512
"""Points of the surface that are turned."""


def spins_freely(points: NDArray[np.float64], line: NDArray[np.float64]) -> bool:
    """Whether every spin about a line (2, 3), zeros for none, leaves a surface as it is.

    Args:
        points: (P, 3) of the surface, in random order, on average half of NEAR_M or less from each other.
        line: direction and point.
    """
    if not line[0].any():
        return False
    tree = KDTree(points)
    return all(leaves_alike(tree, points, turn) for turn in even_turns(line, SPINS))


def leaves_alike(tree: KDTree, points: NDArray[np.float64], turn: NDArray[np.float64]) -> bool:
    """Whether a turn (4, 4) leaves the surface of points (P, 3), and of a tree of them, as it is."""
    turned = transform_points(turn, points[:TESTED])
    return bool((tree.query(turned)[0] < NEAR_M).mean() >= ALIKE)


LOOKED = 12
"""Spins about the line of what is round but for a handle, among what it looks like."""


def turns_alike(
    lines: NDArray[np.float64], orders: NDArray[np.integer], spun: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Turns (T, 4, 4) after which an object looks nearly the same, the first of which leaves it as it is.

    All parts of turns about all its lines, after one another, and spins.

    Args:
        lines: (3, 2, 3), of `symmetry_lines`.
        orders: (3,), likewise.
        spun: (2, 3) the line about which it is round but for what tells the spin; zeros without one.
    """
    turns = products(map(even_turns, lines[orders > 0], orders[orders > 0]))
    return np.concatenate([turns, even_turns(spun, LOOKED)[1:]]) if spun[0].any() else turns
