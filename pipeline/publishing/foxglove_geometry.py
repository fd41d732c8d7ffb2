"""Poses in Foxglove's messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

REFERENCE = "reference"
"""Frame of the run: the first depth frame's camera."""


def quaternions(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations x, y, z, w (..., 4) of poses (..., 4, 4)."""
    flat = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)).as_quat(canonical=True)
    return flat.reshape(*poses.shape[:-2], 4)


def set_vector(message: Any, vector: NDArray[np.float64]) -> None:
    """Fill a message that has x, y and z."""
    message.x, message.y, message.z = map(float, vector)


def set_quaternion(message: Any, xyzw: NDArray[np.float64]) -> None:
    """Fill a message that has x, y, z and w."""
    message.x, message.y, message.z, message.w = map(float, xyzw)
