"""Voxel maps of others on the same frames, poses and grid as a learned shape.

Each returns the probability of being occupied (I, J, K), NaN where the map knows nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from recordings.types import NO_RETURN, CameraIntrinsics
from shapes.geometry.poses import transform_points
from shapes.voxel_grid import VoxelGrid


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedViews:
    """Depth images with their poses.

    Attributes:
        depths_m: (T) images (H, W).
        intrinsics: of their camera.
        reference_from_camera: (T, 4, 4).
        support_m: height of the support plane in the grid's frame.
    """

    depths_m: Sequence[NDArray[np.float32]]
    intrinsics: CameraIntrinsics
    reference_from_camera: NDArray[np.float64]
    support_m: float


ON_SUPPORT_M = 0.003
VoxelMap = Callable[[PosedViews, VoxelGrid], NDArray[np.float64]]


def space_carving(margin_pitches: float, votes: int) -> VoxelMap:
    """Carving: a voxel is free if `votes` views see past its centre by more than a margin."""

    def build(views: PosedViews, grid: VoxelGrid) -> NDArray[np.float64]:
        seen_past = np.zeros(len(grid), np.int64)
        centres = transform_points(grid.reference_from_grid, grid.centres_m)
        size = (views.intrinsics.height, views.intrinsics.width)
        for depth, pose in zip(views.depths_m, views.reference_from_camera, strict=True):
            x, y, z = ((centres - pose[:3, 3]) @ pose[:3, :3]).T
            column = np.rint(views.intrinsics.fx * x / z + views.intrinsics.cx).astype(int)
            row = np.rint(views.intrinsics.fy * y / z + views.intrinsics.cy).astype(int)
            shown = (z > 0) & (row >= 0) & (row < size[0]) & (column >= 0) & (column < size[1])
            measured = np.where(shown, depth[np.where(shown, row, 0), np.where(shown, column, 0)], NO_RETURN)
            seen_past += (measured != NO_RETURN) & (z < measured - margin_pitches * grid.pitch_m)
        return np.where(seen_past >= votes, 0.0, 1.0).reshape(grid.shape)

    return build


def octomap(hit: float, miss: float, free_below: float) -> VoxelMap:
    """OctoMap (Hornung et al. 2013) with its own inverse sensor model; needs octomap-python.

    Voxels between free and occupied count as unknown, lest outliers empty the inside. Returns from the
    support plane end below the grid, or half of them would fill its lowest layer.
    """

    def build(views: PosedViews, grid: VoxelGrid) -> NDArray[np.float64]:
        import octomap as library  # pyright: ignore[reportMissingImports]

        tree = library.OcTree(grid.pitch_m)
        tree.setProbHit(hit)
        tree.setProbMiss(miss)
        grid_from_reference = np.linalg.inv(grid.reference_from_grid)
        for depth, pose in zip(views.depths_m, views.reference_from_camera, strict=True):
            grid_from_camera = grid_from_reference @ pose
            points = _points(depth, views.intrinsics, grid_from_camera, grid)
            eye = grid_from_camera[:3, 3].copy()
            below = _below(points, eye, views.support_m - grid.pitch_m)
            on_support = points[:, 2] < views.support_m + ON_SUPPORT_M
            points = np.ascontiguousarray(np.where(on_support[:, None], below, points))
            beyond = np.linalg.norm(np.maximum(eye, np.asarray(grid.shape) * grid.pitch_m - eye))
            if len(points):  # rays are cut off behind the grid, where nobody asks
                tree.insertPointCloud(points, eye, float(beyond), True)
        tree.updateInnerOccupancy()
        phi = np.full(len(grid), np.nan)
        for index, centre in enumerate(grid.centres_m):
            node = tree.search(centre)
            try:
                phi[index] = node.getOccupancy()
            except library.NullPointerException:
                continue
        undecided = (phi > free_below) & (phi < 0.5)
        return np.where(undecided, np.nan, phi).reshape(grid.shape)

    return build


def open3d_tsdf(truncation_pitches: float) -> VoxelMap:
    """Open3D's truncated signed distances: occupied where they are negative."""

    def build(views: PosedViews, grid: VoxelGrid) -> NDArray[np.float64]:
        side = max(grid.shape)
        volume = o3d.pipelines.integration.UniformTSDFVolume(
            length=side * grid.pitch_m,
            resolution=side,
            sdf_trunc=truncation_pitches * grid.pitch_m,
            color_type=o3d.pipelines.integration.TSDFVolumeColorType.NoColor,
        )
        one = views.intrinsics
        camera = o3d.camera.PinholeCameraIntrinsic(one.width, one.height, one.fx, one.fy, one.cx, one.cy)
        colour = _image(np.zeros((one.height, one.width, 3), np.uint8))
        for depth, pose in zip(views.depths_m, views.reference_from_camera, strict=True):
            image = o3d.geometry.RGBDImage.create_from_color_and_depth(
                colour, _image(depth), depth_scale=1.0, depth_trunc=100.0
            )
            volume.integrate(image, camera, np.linalg.inv(pose) @ grid.reference_from_grid)
        values = np.asarray(volume.extract_volume_tsdf()).reshape(side, side, side, 2)
        distance, weight = np.moveaxis(values[: grid.shape[0], : grid.shape[1], : grid.shape[2]], -1, 0)
        return np.where(weight > 0, np.where(distance < 0, 1.0, 0.0), np.nan)

    return build


def _below(points_m: NDArray[np.float64], eye_m: NDArray[np.float64], height_m: float) -> NDArray[np.float64]:
    """Where the rays from the eye through the points (N, 3) come down to a height; the points if never."""
    down = eye_m[2] - points_m[:, 2]
    stretch = np.where(down > 0, (eye_m[2] - height_m) / np.maximum(down, 1e-9), 1.0)
    return np.asarray(eye_m + stretch[:, None] * (points_m - eye_m), np.float64)


def _image(pixels: Any) -> o3d.geometry.Image:
    return o3d.geometry.Image(pixels)


def _points(
    depth_m: NDArray[np.float32],
    intrinsics: CameraIntrinsics,
    grid_from_camera: NDArray[np.float64],
    grid: VoxelGrid,
) -> NDArray[np.float64]:
    """Points (N, 3) in the grid frame of the pixels whose rays pass the grid; ends just behind it."""
    rows, columns = np.indices(depth_m.shape)
    directions = intrinsics.rays(columns, rows)[depth_m != NO_RETURN] @ grid_from_camera[:3, :3].T
    z = depth_m[depth_m != NO_RETURN].astype(np.float64)
    eye, extent = grid_from_camera[:3, 3], np.asarray(grid.shape) * grid.pitch_m
    with np.errstate(divide="ignore"):
        sides = np.stack([(0.0 - eye) / directions, (extent - eye) / directions])
    enter, leave = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
    passes = (enter < leave) & (leave > 0) & (z > enter)
    return np.ascontiguousarray(eye + directions[passes] * z[passes, None])
