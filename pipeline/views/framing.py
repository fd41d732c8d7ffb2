"""Where the eye stands in a 3D view: so that the scene fills it and what matters is inside and not hidden."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

EYE_FOV_RAD = np.radians(55.0)
"""Rerun's vertical field of view."""
ASPECT = 0.93
"""Width over height of the 3D panel in a picture of 1600 x 1000."""
WIDE_ASPECT = 1.8
"""The same, at least, of panels beside it."""
EDGE = 1.05
"""What lies nearer to the edge than a fortieth counts as outside."""
CELLS = 30
"""Of the coarse picture in which candidates are compared, along each side."""
POINTS = 9000
"""Of the cloud that are looked at: ten a cell."""
HIDDEN = 0.97
"""A point is hidden where the cloud has something nearer than this share of its distance."""
ASIDE_DEG, ABOVE_DEG, AWAY = (
    (0.0, -25.0, 25.0, -50.0, 50.0),
    (5.0, 15.0, 30.0, 45.0),
    (0.35, 0.5, 0.7, 1.0, 1.4),
)
"""Candidates round what is looked at: angles from the first camera's side, distances in its diagonals."""
BEHIND, OVER, BESIDE = (0.2, 0.4, 0.8, 1.3, 2.0), (0.0, 0.2, 0.5, 1.0), (-0.6, 0.0, 0.6)
"""Candidates behind the first camera, in units of the path's extent."""
LEAST_EXTENT = 0.12
"""Of a path, as a share of the diagonal: a camera that stood still is looked at from a little behind too."""
TOWARD_PATH = (0.0, 0.3, 0.6)
"""How far the eye turns from what is looked at toward the middle of what is wanted."""
STEPS = (0.2, 0.1, 0.05, 0.025)
"""By which the best candidate is moved while that is better, in distances between eye and target."""
STRAY = 0.2
"""Score that a candidate loses for a right angle away from the first camera's side."""


@dataclass(frozen=True, eq=False)
class Eye:
    """Position, target and up (3,), metres in the reference frame."""

    position: NDArray[np.float64]
    target: NDArray[np.float64]
    up: NDArray[np.float64]


def chosen_eye(
    cloud_m: NDArray[np.floating],
    wanted_m: NDArray[np.floating],
    first_camera: NDArray[np.float64],
    up: NDArray[np.float64],
    focus_m: NDArray[np.floating] | None = None,
) -> Eye:
    """The eye whose view is filled best, with all that is wanted inside and in sight.

    The best of some candidates; where nothing is to stand in the middle, small moves from there on make it
    better (pattern search).

    Args:
        cloud_m: (N, 3) what there is to see.
        wanted_m: (W, 3) what must be seen: the path, the objects.
        first_camera: (4, 4), from whose side people expect to look.
        up: unit vector (3,).
        focus_m: (F, 3) what is looked at; the middle 90% of the cloud without it.
    """
    cloud = np.asarray(cloud_m[:: -(-len(cloud_m) // POINTS) or 1], np.float64)
    wanted = np.asarray(wanted_m, np.float64)
    low, high = _box(cloud if len(cloud) else wanted) if focus_m is None else _box(focus_m, margin=0.0)
    centre, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.05)
    sight = centre - first_camera[:3, 3]
    if np.linalg.norm(sight) < 0.05 * size:
        sight = first_camera[:3, 2]
    sight = sight / np.linalg.norm(sight)
    middle = wanted.mean(axis=0) if len(wanted) else centre
    positions = [*_round(centre, size, sight, up), *_behind(first_camera, wanted, size, sight, up)]
    eyes = [
        Eye(position, centre + share * (middle - centre), up)
        for position in positions
        for share in TOWARD_PATH
    ]
    best = max(eyes, key=lambda eye: _score(eye, cloud, wanted, sight))
    for step in STEPS if focus_m is None else ():
        while (moved := max(_moved(best, step), key=lambda eye: _score(eye, cloud, wanted, sight))) != best:
            best = moved
    return best


def _round(
    centre: NDArray[np.float64], size: float, sight: NDArray[np.float64], up: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """Positions round what is looked at, on the side from which the first camera saw it."""
    level = -sight + (sight @ up) * up
    if np.linalg.norm(level) < 1e-3:
        level = np.eye(3)[np.abs(up).argmin()]
        level = level - (level @ up) * up
    ahead = level / np.linalg.norm(level)
    aside = np.cross(up, ahead)
    return [
        centre
        + far * size * (np.cos(above) * (np.cos(turn) * ahead + np.sin(turn) * aside) + np.sin(above) * up)
        for turn, above, far in itertools.product(np.radians(ASIDE_DEG), np.radians(ABOVE_DEG), AWAY)
    ]


def _behind(
    first_camera: NDArray[np.float64],
    wanted_m: NDArray[np.float64],
    size: float,
    sight: NDArray[np.float64],
    up: NDArray[np.float64],
) -> list[NDArray[np.float64]]:
    """Positions behind and above the first camera, from which its path is seen in front of the scene."""
    extent = float(np.linalg.norm(np.ptp(wanted_m, axis=0))) if len(wanted_m) else 0.0
    extent = float(np.clip(extent, LEAST_EXTENT * size, size))
    aside = np.cross(sight, up)
    return [
        first_camera[:3, 3] + extent * (-back * sight + over * up + beside * aside)
        for back, over, beside in itertools.product(BEHIND, OVER, BESIDE)
    ]


def _moved(eye: Eye, step: float) -> list[Eye]:
    """An eye, itself first, and those a step ahead, aside or above, or with the target moved across."""
    ahead = eye.target - eye.position
    aside = np.cross(ahead, eye.up)
    aside *= np.linalg.norm(ahead) / max(float(np.linalg.norm(aside)), 1e-9)
    above = np.cross(aside, ahead) / np.linalg.norm(ahead)
    moves = [sign * step * one for one in (ahead, aside, above) for sign in (-1, 1)]
    stood = [Eye(eye.position + one, eye.target, eye.up) for one in moves]
    turned = [Eye(eye.position, eye.target + one, eye.up) for one in moves[2:]]
    return [eye, *stood, *turned]


def _score(
    eye: Eye, cloud: NDArray[np.float64], wanted_m: NDArray[np.float64], sight: NDArray[np.float64]
) -> float:
    """Share of the picture that is filled, and twice the share of what is wanted that is in sight."""
    cells, depth = projected(eye, cloud)
    inside = cells >= 0
    nearest = np.full(CELLS * CELLS, np.inf)
    np.minimum.at(nearest, cells[inside], depth[inside])
    score = float(np.isfinite(nearest).mean())
    if len(wanted_m):
        cells, depth = projected(eye, wanted_m)
        seen = cells >= 0
        seen[seen] = HIDDEN * depth[seen] < nearest[cells[seen]]
        score += 2 * float(seen.mean())
    ahead = eye.target - eye.position
    angle = np.arccos(np.clip(ahead @ sight / np.linalg.norm(ahead), -1, 1))
    return score - STRAY * float(angle) / (np.pi / 2)


def seen_from(eye: Eye, points_m: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points (N, 3) to the right, below and ahead of an eye, metres."""
    forward = eye.target - eye.position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, eye.up)
    right = right / np.linalg.norm(right)
    return (points_m - eye.position) @ np.stack([right, np.cross(forward, right), forward], axis=1)


def eye_before(points_m: NDArray[np.floating], toward: NDArray[np.float64], up: NDArray[np.float64]) -> Eye:
    """The nearest eye on a side of points (N, 3) that has all of them in a panel wider than it is high.

    Args:
        points_m: that are looked at, in the middle of their box.
        toward: unit vector (3,) from there to the eye.
        up: unit vector (3,).
    """
    centre = (points_m.min(axis=0) + points_m.max(axis=0)) / 2
    across, below, ahead = seen_from(Eye(centre, centre - toward, up), points_m).T
    half = np.tan(EYE_FOV_RAD / 2)
    wide, high = abs(across) / (half * WIDE_ASPECT), abs(below) / half
    distance_m = EDGE * float((np.maximum(wide, high) - ahead).max())
    return Eye(centre + distance_m * toward, centre, up)


def projected(eye: Eye, points_m: NDArray[np.floating]) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
    """Cell (N,) of the coarse picture in which each point falls, -1 outside, and its distance ahead (N,)."""
    local = seen_from(eye, points_m)
    depth = local[:, 2]
    half = np.tan(EYE_FOV_RAD / 2) * np.maximum(depth, 1e-9)
    place = EDGE * np.stack([local[:, 0] / (half * ASPECT), local[:, 1] / half], axis=1)
    inside = (depth > 1e-3) & (np.abs(place) < 1).all(axis=1)
    column, row = np.clip(((place + 1) / 2 * CELLS), 0, CELLS - 1).astype(int).T
    return np.where(inside, row * CELLS + column, -1), depth


def _box(
    points_m: NDArray[np.floating], margin: float = 5.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (3,) of the box that leaves out so many percent on each side."""
    low, high = np.percentile(np.asarray(points_m, np.float64), [margin, 100 - margin], axis=0)
    return low, high
