"""Grids of candidate poses over position and viewing angle: near a prediction, or anywhere in the map."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

LOCAL_ANGLES_RAD = (-0.07, 0.0, 0.07)
"""Starts of Gauss-Newton. Chosen by hand."""

LOCAL_SHIFTS_M = (-0.06, 0.06)
"""As `LOCAL_ANGLES_RAD`."""

ORBIT_STEP_DEG = 6
"""Search effort. Chosen by hand."""

ORBIT_ELEVATIONS_DEG = (0, 10, 20, 30, 40, 50, 60)
"""Of hand-held views of an object."""

ORBIT_CLIMBS_DEG = (-30, -15, 0, 15, 30)
"""Changes of elevation from one view to the next."""

ORBIT_DISTANCES = (0.9, 1.05, 1.25)
"""Distances to the pivot of an orbit, in depths at the image centre."""

TURNS_DEG = tuple(range(-180, 180, 15))

TILTS_DEG = (-20, 0, 20)
"""Of hand-held cameras. Chosen by hand."""

LOOK_TURNS_DEG, LOOK_TILTS_DEG = (-20, 0, 20), (-12, 0, 12)
"""Of a camera that has come back to a keyframe. Search effort. Chosen by hand."""


@cache
def local_grid() -> NDArray[np.float32]:
    """Offsets (G, 6) around a prediction: 27 viewing angles at 7 positions, translation first."""
    angles = itertools.product(LOCAL_ANGLES_RAD, repeat=3)
    shifts = [np.zeros(3), *(step * axis for step in LOCAL_SHIFTS_M for axis in np.eye(3))]
    return np.asarray([[*shift, *angle] for angle in angles for shift in shifts], np.float32)


def orbit_steps(distances_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses last_from_camera (C, 4, 4) on circles, level and higher and lower, round points ahead.

    The circle's axis is vertical for a camera that looks down by each of `ORBIT_ELEVATIONS_DEG`; a climb
    turns the camera about its own horizontal axis through the point.
    """
    azimuths = np.radians(np.arange(0, 360, ORBIT_STEP_DEG))
    climbs = Rotation.from_euler("x", np.reshape(ORBIT_CLIMBS_DEG, (-1, 1)), degrees=True).as_matrix()
    steps = []
    for elevation, distance in itertools.product(np.radians(ORBIT_ELEVATIONS_DEG), distances_m):
        axis = np.asarray([0.0, -np.cos(elevation), -np.sin(elevation)])
        pivot = np.asarray([0.0, 0.0, distance])
        round_axis = Rotation.from_rotvec(azimuths[:, None] * axis).as_matrix()
        turned = (round_axis[:, None] @ climbs[None]).reshape(-1, 3, 3)
        step = np.tile(np.eye(4), (len(turned), 1, 1))
        step[:, :3, :3] = turned
        step[:, :3, 3] = pivot - turned @ pivot
        steps.append(step)
    return np.concatenate(steps)


def turn_grid() -> NDArray[np.float64]:
    """Poses last_from_camera (C, 4, 4) of a camera that turns and tilts on the spot."""
    return _turns(TURNS_DEG, TILTS_DEG)


def _turns(turns_deg: Sequence[float], tilts_deg: Sequence[float]) -> NDArray[np.float64]:
    """Poses (C, 4, 4) on the spot, turned about the image's vertical, then tilted."""
    angles = np.asarray(list(itertools.product(turns_deg, tilts_deg)), float)
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("yx", angles, degrees=True).as_matrix()
    return poses


def grid_everywhere(
    last: NDArray[np.float64], keyframes: NDArray[np.float64], distances_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Candidates reference_from_camera (C, 4, 4): orbits and turns from the last pose, looks from keyframes.

    Args:
        last: (4, 4) last known pose.
        keyframes: (N, 4, 4) poses that the camera may have come back to.
        distances_m: (D,) to the pivots of orbits.
    """
    looks = _turns(LOOK_TURNS_DEG, LOOK_TILTS_DEG)
    returns = (keyframes[:, None] @ looks[None]).reshape(-1, 4, 4)
    return np.concatenate([last @ orbit_steps(distances_m), last @ turn_grid(), returns])
