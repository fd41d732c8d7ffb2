"""KISS-ICP as it is used alone."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics, Frame
from slam.odometry import KissOdometry


def track(frames: Iterable[Frame], intrinsics: CameraIntrinsics, voxel_m: float) -> NDArray[np.float64]:
    """Poses (T, 4, 4) by odometry with one voxel size."""
    odometry = KissOdometry(intrinsics, voxel_m)
    pose, poses = np.eye(4), []
    for frame in frames:
        pose = pose @ odometry.register(frame)
        poses.append(pose)
    return np.linalg.inv(poses[0]) @ np.stack(poses)
