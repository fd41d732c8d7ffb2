"""The noise-free ceiling of a set of views: the voxels that no ideal ray reaches stay occupied."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics
from shapes.voxel_grid import VoxelGrid


def reached_voxels(
    depths_m: Sequence[NDArray[np.float32]],
    intrinsics: CameraIntrinsics,
    reference_from_camera: NDArray[np.float64],
    grid: VoxelGrid,
) -> NDArray[np.bool_]:
    """Voxels (I, J, K) through which some noise-free ray passes before it meets a surface."""
    reached = np.zeros(len(grid), np.bool_)
    step = grid.pitch_m / 2
    for depth, pose in zip(depths_m, reference_from_camera, strict=True):
        grid_from_camera = np.linalg.inv(grid.reference_from_grid) @ pose
        eye, extent = grid_from_camera[:3, 3], np.asarray(grid.shape) * grid.pitch_m
        stride = max(1, int(step * intrinsics.fx / np.linalg.norm(eye - extent / 2)))
        rows, columns = np.mgrid[0 : intrinsics.height : stride, 0 : intrinsics.width : stride]
        directions = intrinsics.rays(columns, rows).reshape(-1, 3) @ grid_from_camera[:3, :3].T
        with np.errstate(divide="ignore"):
            sides = np.stack([-eye / directions, (extent - eye) / directions])
        enter, leave = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
        end = np.minimum(leave, depth[::stride, ::stride].reshape(-1))
        passing = (enter < end) & (end > 0)
        directions, enter, end = directions[passing], enter[passing], end[passing]
        for number in range(int(np.ceil((end - enter).max(initial=0.0) / step)) + 1):
            s = enter + (number + 0.5) * step
            points = eye + directions[s < end] * s[s < end, None]
            index = np.clip(np.floor(points / grid.pitch_m).astype(int), 0, np.asarray(grid.shape) - 1)
            reached[np.ravel_multi_index(tuple(index.T), grid.shape)] = True
    return reached.reshape(grid.shape)
