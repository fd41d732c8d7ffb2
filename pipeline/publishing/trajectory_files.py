"""Camera trajectories as other tools read them: TUM and KITTI, and the frames that were lost.

A lost frame has no pose. TUM files have stamps, so its line is left out; KITTI files have a line for every
frame, which is of `nan` for a lost one, so that no tool takes it for a pose; lost.txt lists them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam.result import SlamResult


def tum_lines(result: SlamResult) -> str:
    """`timestamp tx ty tz qx qy qz qw` in seconds and metres, 9 decimals, of every frame that was found."""
    times_ns, poses = result.times_ns[~result.lost], result.mean[~result.lost]
    rotations = (
        Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True) if len(poses) else np.empty((0, 4))
    )
    rows = _rounded(np.concatenate([poses[:, :3, 3], rotations], axis=1))
    return "".join(
        f"{seconds_text(int(time_ns))} {' '.join(f'{value:.9f}' for value in row)}\n"
        for time_ns, row in zip(times_ns, rows, strict=True)
    )


def kitti_lines(result: SlamResult) -> str:
    """The upper three rows of each frame's pose (T, 4, 4), row by row; `nan` for a frame that was lost."""
    rows = _rounded(result.mean[:, :3].reshape(-1, 12))
    rows[result.lost] = np.nan
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows)


def lost_lines(result: SlamResult) -> str:
    """`frame timestamp` of every frame that was lost."""
    lost = np.flatnonzero(result.lost)
    return "".join(f"{frame} {seconds_text(int(result.times_ns[frame]))}\n" for frame in lost)


def seconds_text(time_ns: int) -> str:
    """Nanoseconds as decimal seconds, exactly."""
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return f"{seconds}.{nanoseconds:09d}"


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """To 9 decimals, without negative zeros."""
    return np.round(values, 9) + 0.0
