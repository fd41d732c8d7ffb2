"""KISS-ICP (Vizzo et al. 2023) on depth images: a motion estimate from points alone, frame after frame.

Its defaults suit lidar on cars; here voxels, ranges and thresholds are set for depth cameras. It knows
nothing of its own failures (on a table orbit it reports no motion at all), so its estimate is only ever
one more start of the search, scored like every other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics, Frame

POINT_STRIDE_PX = 4
"""Points enough for KISS-ICP's voxels: 19,200 of a 640 x 480 image."""

VOXEL_M, MAX_RANGE_M = 0.05, 10.0
"""Side of the map's voxels; farther points are left out."""

INITIAL_THRESHOLD_M, LEAST_MOTION_M = 0.2, 0.01
"""Correspondence distance before any motion was seen; motion under which it does not adapt."""


class KissOdometry:
    """KISS-ICP's state over one recording."""

    def __init__(self, intrinsics: CameraIntrinsics, voxel_m: float = VOXEL_M) -> None:
        """Before the first frame; threads are one, so that equal frames give equal poses."""
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        config = KISSConfig()
        config.data.deskew = False
        config.data.max_range = MAX_RANGE_M
        config.data.min_range = 0.1
        config.mapping.voxel_size = voxel_m
        config.adaptive_threshold.initial_threshold = INITIAL_THRESHOLD_M
        config.adaptive_threshold.min_motion_th = LEAST_MOTION_M
        config.registration.max_num_threads = 1
        self._intrinsics = intrinsics
        self._icp = KissICP(config)
        self._last = np.eye(4)

    def register(self, frame: Frame) -> NDArray[np.float64]:
        """(4, 4) previous_from_camera: the motion since the previous frame, the identity for the first."""
        points = points_of(frame, self._intrinsics)
        if len(points):
            self._icp.register_frame(points, np.empty(0))
        pose = np.asarray(self._icp.last_pose, np.float64)
        step = np.linalg.inv(self._last) @ pose
        self._last = pose.copy()
        return step


def points_of(frame: Frame, intrinsics: CameraIntrinsics) -> NDArray[np.float64]:
    """Points (n, 3) in the camera frame of every `POINT_STRIDE_PX`-th pixel with a return."""
    height, width = frame.depth_m.shape
    camera = intrinsics.resized(width, height)
    v, u = np.mgrid[0:height:POINT_STRIDE_PX, 0:width:POINT_STRIDE_PX]
    depth = frame.depth_m[::POINT_STRIDE_PX, ::POINT_STRIDE_PX]
    return (camera.rays(u, v) * depth[..., None])[depth > 0]
