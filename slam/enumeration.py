"""Grids of candidate poses over position and viewing angle."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

LOCAL_ANGLES_RAD = (-0.07, 0.0, 0.07)
LOCAL_SHIFTS_M = (-0.06, 0.0, 0.06)


def local_grid() -> NDArray[np.float32]:
    """Offsets (G, 6) around a prediction: 27 viewing angles at 7 positions, translation first."""
    angles = itertools.product(LOCAL_ANGLES_RAD, repeat=3)
    steps = [LOCAL_SHIFTS_M[0], LOCAL_SHIFTS_M[2]]
    shifts = [np.zeros(3), *(step * axis for step in steps for axis in np.eye(3))]
    return np.asarray([[*shift, *angle] for angle in angles for shift in shifts], np.float32)
