"""Camera trajectories as other tools read them: TUM and KITTI, one line for each depth frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


def tum_lines(times_ns: NDArray[np.int64], reference_from_camera: NDArray[np.float64]) -> str:
    """`timestamp tx ty tz qx qy qz qw` in seconds and metres, 9 decimals, of poses (T, 4, 4)."""
    rotations = Rotation.from_matrix(reference_from_camera[:, :3, :3]).as_quat(canonical=True)
    rows = _rounded(np.concatenate([reference_from_camera[:, :3, 3], rotations], axis=1))
    return "".join(
        f"{_seconds(int(time_ns))} {' '.join(f'{value:.9f}' for value in row)}\n"
        for time_ns, row in zip(times_ns, rows, strict=True)
    )


def kitti_lines(reference_from_camera: NDArray[np.float64]) -> str:
    """The upper three rows of each pose (T, 4, 4), row by row."""
    rows = _rounded(reference_from_camera[:, :3].reshape(-1, 12))
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows)


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """To 9 decimals, without negative zeros."""
    return np.round(values, 9) + 0.0


def _seconds(time_ns: int) -> str:
    """Nanoseconds as decimal seconds, exactly."""
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return f"{seconds}.{nanoseconds:09d}"
