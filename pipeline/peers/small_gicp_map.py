"""small_gicp: voxelised GICP of every frame against a growing Gaussian voxel map, constant velocity."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import small_gicp
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics, Frame
from slam.odometry import points_of


def track(frames: Iterable[Frame], intrinsics: CameraIntrinsics, voxel_m: float) -> NDArray[np.float64]:
    """Poses (T, 4, 4) against a map of one voxel size."""
    voxel_map = small_gicp.GaussianVoxelMap(voxel_m)
    poses: list[NDArray[np.float64]] = []
    for frame in frames:
        points = points_of(frame, intrinsics)
        cloud, _ = small_gicp.preprocess_points(points, downsampling_resolution=0.25 * voxel_m)
        velocity = np.linalg.inv(poses[-2]) @ poses[-1] if len(poses) > 1 else np.eye(4)
        pose = np.eye(4)
        if poses:
            result = small_gicp.align(
                voxel_map, cloud, poses[-1] @ velocity, max_correspondence_distance=2 * voxel_m
            )
            pose = np.asarray(result.T_target_source)
        voxel_map.insert(cloud, pose)
        poses.append(pose)
    return np.stack(poses)
