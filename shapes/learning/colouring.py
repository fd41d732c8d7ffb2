"""Colours of voxels: the mean of what the views show where their surface is at the voxel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recordings.types import NO_RETURN, CameraIntrinsics, Frame
from shapes.voxel_grid import VoxelGrid

AT_SURFACE_PITCHES = 1.5


def voxel_colours(
    occupied: NDArray[np.bool_],
    grid: VoxelGrid,
    frames: Sequence[Frame],
    intrinsics: CameraIntrinsics,
    reference_from_camera: NDArray[np.float64],
) -> NDArray[np.uint8] | None:
    """Colour (I, J, K, 3) of the nearest occupied voxel that was seen in colour; None if there is none."""
    surface = np.flatnonzero(occupied.ravel())
    points = grid.centres_m[surface] @ grid.reference_from_grid[:3, :3].T + grid.reference_from_grid[:3, 3]
    total, weight = np.zeros((len(surface), 3)), np.zeros(len(surface))
    for frame, pose in zip(frames, reference_from_camera, strict=True):
        if frame.rgb is None:
            continue
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        z_safe = np.where(z > 1e-3, z, 1.0)
        column = np.rint(intrinsics.fx * x / z_safe + intrinsics.cx).astype(int)
        row = np.rint(intrinsics.fy * y / z_safe + intrinsics.cy).astype(int)
        shown = (
            (z > 1e-3) & (column >= 0) & (column < intrinsics.width) & (row >= 0) & (row < intrinsics.height)
        )
        depth = frame.depth_m[row[shown], column[shown]]
        at_surface = (depth != NO_RETURN) & (np.abs(depth - z[shown]) < AT_SURFACE_PITCHES * grid.pitch_m)
        if frame.rgb_known is not None:
            at_surface &= frame.rgb_known[row[shown], column[shown]]
        index = np.flatnonzero(shown)[at_surface]
        total[index] += frame.rgb[row[index], column[index]]
        weight[index] += 1
    coloured = weight > 0
    if not coloured.any():
        return None
    colours = np.zeros((len(grid), 3), np.uint8)
    colours[surface[coloured]] = np.rint(total[coloured] / weight[coloured, None])
    known = np.zeros(len(grid), np.bool_)
    known[surface[coloured]] = True
    nearest = np.zeros((3, *grid.shape), np.int32)
    ndimage.distance_transform_edt(
        ~known.reshape(grid.shape), return_distances=False, return_indices=True, indices=nearest
    )
    return np.ascontiguousarray(colours.reshape(*grid.shape, 3)[tuple(nearest)])
