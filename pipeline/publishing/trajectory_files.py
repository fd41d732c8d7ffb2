"""Camera trajectories as other tools read them: TUM and KITTI, and the frames that were lost.

A lost frame has no pose. TUM files have stamps, so its line is left out; KITTI files have a line for every
frame, which is of `nan` for a lost one, so that no tool takes it for a pose; lost.txt lists them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam.result import SlamResult


def path_texts(result: SlamResult) -> dict[str, str]:
    """The files of a camera's path, by name."""
    found = ~result.lost
    poses = np.where(found[:, None, None], result.mean, np.nan)
    return {
        "trajectory.tum": tum_lines(result.times_ns[found], result.mean[found]),
        "trajectory.kitti": kitti_lines(poses),
        "lost.txt": lost_lines(result),
    }


def tum_lines(times_ns: NDArray[np.int64], reference_from_camera: NDArray[np.float64]) -> str:
    """`timestamp tx ty tz qx qy qz qw` in seconds and metres, 9 decimals, of poses (T, 4, 4)."""
    if not len(times_ns):
        return ""
    rotations = Rotation.from_matrix(reference_from_camera[:, :3, :3]).as_quat(canonical=True)
    rows = _rounded(np.concatenate([reference_from_camera[:, :3, 3], rotations], axis=1))
    return "".join(
        f"{seconds_text(int(time_ns))} {' '.join(f'{value:.9f}' for value in row)}\n"
        for time_ns, row in zip(times_ns, rows, strict=True)
    )


def kitti_lines(reference_from_camera: NDArray[np.float64]) -> str:
    """The upper three rows of each pose (T, 4, 4), row by row."""
    rows = _rounded(reference_from_camera[:, :3].reshape(-1, 12))
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
