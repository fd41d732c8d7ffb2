"""Colours of voxels: the mean of what the views show where their surface is at the voxel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recordings.types import NO_RETURN, CameraIntrinsics, Frame
from shapes.geometry.poses import transform_points
from shapes.voxel_grid import VoxelGrid

AT_SURFACE_PITCHES = 1.5
"""In voxels. Chosen by hand."""


class ColourSums:
    """Mean colours of points of a surface over the frames that show them.

    Args:
        points_m: (N, 3) in the reference frame.
        at_surface_m: a frame shows a point if its depth there is within this of the point's.
    """

    def __init__(self, points_m: NDArray[np.float64], *, at_surface_m: float) -> None:
        self._points = points_m
        self._at_surface_m = at_surface_m
        self._total, self._weight = np.zeros((len(points_m), 3)), np.zeros(len(points_m))

    def add(
        self, frame: Frame, intrinsics: CameraIntrinsics, reference_from_camera: NDArray[np.float64]
    ) -> None:
        """Take in a frame; one without colour changes nothing."""
        if frame.rgb is None:
            return
        pose = reference_from_camera
        x, y, z = ((self._points - pose[:3, 3]) @ pose[:3, :3]).T
        z_safe = np.where(z > 1e-3, z, 1.0)
        column = np.rint(intrinsics.fx * x / z_safe + intrinsics.cx).astype(int)
        row = np.rint(intrinsics.fy * y / z_safe + intrinsics.cy).astype(int)
        shown = (
            (z > 1e-3) & (column >= 0) & (column < intrinsics.width) & (row >= 0) & (row < intrinsics.height)
        )
        depth = frame.depth_m[row[shown], column[shown]]
        at_surface = (depth != NO_RETURN) & (np.abs(depth - z[shown]) < self._at_surface_m)
        if frame.rgb_known is not None:
            at_surface &= frame.rgb_known[row[shown], column[shown]]
        index = np.flatnonzero(shown)[at_surface]
        self._total[index] += frame.rgb[row[index], column[index]]
        self._weight[index] += 1

    def means(self) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Colours (N, 3), 0 where no frame shows the point, and which points (N,) one shows."""
        known = self._weight > 0
        means = np.rint(self._total / np.maximum(self._weight, 1)[:, None])
        return means.astype(np.uint8), known


def voxel_colours(
    occupied: NDArray[np.bool_],
    grid: VoxelGrid,
    frames: Sequence[Frame],
    intrinsics: CameraIntrinsics,
    reference_from_camera: NDArray[np.float64],
) -> NDArray[np.uint8] | None:
    """Colour (I, J, K, 3) of the nearest occupied voxel that was seen in colour; None if there is none."""
    surface = np.flatnonzero(occupied.ravel())
    points = transform_points(grid.reference_from_grid, grid.centres_m[surface])
    sums = ColourSums(points, at_surface_m=AT_SURFACE_PITCHES * grid.pitch_m)
    for frame, pose in zip(frames, reference_from_camera, strict=True):
        sums.add(frame, intrinsics, pose)
    means, coloured = sums.means()
    if not coloured.any():
        return None
    colours = np.zeros((len(grid), 3), np.uint8)
    colours[surface[coloured]] = means[coloured]
    known = np.zeros(len(grid), np.bool_)
    known[surface[coloured]] = True
    nearest = np.zeros((3, *grid.shape), np.int32)
    ndimage.distance_transform_edt(
        ~known.reshape(grid.shape), return_distances=False, return_indices=True, indices=nearest
    )
    return np.ascontiguousarray(colours.reshape(*grid.shape, 3)[tuple(nearest)])
