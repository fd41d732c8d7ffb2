"""Open3D: frame-to-frame point-to-plane odometry, and tracking against its own TSDF model."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics, Frame

DEPTH_SCALE = 1000.0
DEPTH_MAX_M = 5.0
VOXEL_M = 0.01
TRUNCATION_VOXELS = 8.0


def _matrix(intrinsics: CameraIntrinsics) -> o3d.core.Tensor:
    rows = [[intrinsics.fx, 0, intrinsics.cx + 0.5], [0, intrinsics.fy, intrinsics.cy + 0.5], [0, 0, 1]]
    return o3d.core.Tensor.from_numpy(np.asarray(rows, np.float64))


def _images(frame: Frame) -> tuple[o3d.t.geometry.Image, o3d.t.geometry.Image]:
    depth = o3d.t.geometry.Image(
        o3d.core.Tensor.from_numpy(np.round(frame.depth_m * DEPTH_SCALE).astype(np.uint16))
    )
    grey = np.zeros((*frame.depth_m.shape, 3), np.uint8)
    return depth, o3d.t.geometry.Image(o3d.core.Tensor.from_numpy(grey))


def track_odometry(frames: Iterable[Frame], intrinsics: CameraIntrinsics) -> NDArray[np.float64]:
    """Poses (T, 4, 4) by adding up multi-scale point-to-plane odometry."""
    method = o3d.t.pipelines.odometry.Method.PointToPlane
    poses, previous = [np.eye(4)], None
    for frame in frames:
        image = o3d.t.geometry.RGBDImage(*_images(frame)[::-1])
        if previous is not None:
            result = o3d.t.pipelines.odometry.rgbd_odometry_multi_scale(
                image,
                previous,
                _matrix(intrinsics),
                depth_scale=DEPTH_SCALE,
                depth_max=DEPTH_MAX_M,
                method=method,
            )
            poses.append(poses[-1] @ result.transformation.numpy())
        previous = image
    return np.stack(poses)


def track_model(frames: Iterable[Frame], intrinsics: CameraIntrinsics) -> NDArray[np.float64]:
    """Poses (T, 4, 4) by tracking each frame against the TSDF model of those before."""
    slam = o3d.t.pipelines.slam
    height, width = next(iter(frames)).depth_m.shape
    pose = o3d.core.Tensor.from_numpy(np.eye(4))
    device = o3d.core.Device("CPU:0")
    model = slam.Model(VOXEL_M, 16, 10000, pose, device)
    seen, rendered = (slam.Frame(height, width, _matrix(intrinsics), device) for _ in range(2))
    poses = []
    for index, frame in enumerate(frames):
        depth, colour = _images(frame)
        seen.set_data_from_image("depth", depth)
        seen.set_data_from_image("color", colour)
        if index:
            result = model.track_frame_to_model(seen, rendered, DEPTH_SCALE, DEPTH_MAX_M)
            pose = pose @ result.transformation
        model.update_frame_pose(index, pose)
        model.integrate(seen, DEPTH_SCALE, DEPTH_MAX_M, TRUNCATION_VOXELS)
        model.synthesize_model_frame(rendered, DEPTH_SCALE, 0.1, DEPTH_MAX_M, TRUNCATION_VOXELS, False)
        poses.append(pose.cpu().numpy().copy())
    return np.stack(poses)
