"""Region of the object: the support plane removed, the cluster nearest to what the cameras observed.

All views are fused first, so the cluster has grown over the views when it is chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from recordings.types import NO_RETURN, CameraIntrinsics
from shapes.geometry.poses import transform_points
from shapes.learning.config import LearnConfig
from shapes.learning.support_plane import INLIER_M, Plane, fit_plane, planes_below
from shapes.voxel_grid import VoxelGrid

REACH_M = 0.6
"""Points farther from what the cameras looked at are not considered."""
POINTS_PER_VIEW = 40_000
"""Memory and time."""
CELL_M = 0.01
"""Edge of the cells in which points are averaged and clusters are connected."""
PIXEL_REACH = 5
"""Pixels round the one that a user points at: a click is seldom better."""
FEWEST_CELLS = 8
"""A cluster of fewer is noise."""
LEAST_HEIGHT_M = 0.006
"""The inlier band of the support plane."""
RING_M = 0.1
"""Width of the surroundings in which a support plane must show."""
STEP_M = 0.08
"""What is seen so far below a plane, close to the object, speaks against its being the support."""
SECTORS = 16
"""Of the surroundings, 22.5 degrees each."""
COVERED = 0.5
"""Half of the sectors."""
SURROUNDINGS_M = 0.1
"""Width of the support that is looked for round an object. Chosen by hand."""
MARGIN_M = 0.01
"""Round the cluster, for what thinning left out."""
MARGIN_VOXELS = 3
"""As `MARGIN_M`, at coarse pitches."""
LARGEST_GRID = 8_000_000
"""Voxels; more, of which learning holds some 300 bytes each, would take minutes and gigabytes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Candidate:
    plane: Plane
    cluster: NDArray[np.float64]

    @property
    def size(self) -> float:
        return float(np.linalg.norm(np.ptp(self.cluster, axis=0)))


def object_grid(
    depths_m: Sequence[NDArray[np.float32]],
    intrinsics: CameraIntrinsics,
    reference_from_camera: NDArray[np.float64],
    config: LearnConfig,
) -> VoxelGrid:
    """Grid round the object that T views (T, 4, 4) look at, standing on its support plane if there is one.

    Raises:
        ValueError: no object was found, or the region is too large for the pitch.
    """
    rng = np.random.default_rng(0)
    clouds = [
        _cloud(depth, intrinsics, pose) for depth, pose in zip(depths_m, reference_from_camera, strict=True)
    ]
    points = np.concatenate(clouds)
    if config.box is None:
        if config.pixel is None:
            target = observed_region(depths_m, intrinsics, reference_from_camera)
        else:
            target = point_at_pixel(depths_m[0], intrinsics, reference_from_camera[0], config.pixel)
        low, high = target - REACH_M, target + REACH_M
    else:
        low, high = np.asarray(config.box[:3]), np.asarray(config.box[3:])
        target = (low + high) / 2
    cells = _averaged(points[_within(points, low - SURROUNDINGS_M, high + SURROUNDINGS_M)])
    inside = _within(cells, low, high)
    if not inside.any():
        raise ValueError(
            "nothing was measured in the region; --box is in metres, in the camera of the first frame used"
        )
    eyes = reference_from_camera[:, :3, 3]
    found = [
        candidate
        for plane in planes_below(cells, eyes, rng)
        if (candidate := _standing_on(plane, cells, inside, target)) is not None
    ]
    if found:
        best = min(found, key=lambda candidate: candidate.size)
        around = np.linalg.norm(cells - best.cluster.mean(axis=0), axis=1) < best.size / 2 + RING_M
        on_it = around & (np.abs(best.plane.heights(cells)) < INLIER_M)
        plane = fit_plane(cells[on_it], eyes)
        return _grid(
            best.cluster, _upright(plane, best.cluster, reference_from_camera[0]), config, on_plane=True
        )
    if config.box is not None:  # whatever it holds is the object
        return _grid(np.stack([low, high]), np.eye(4), config, on_plane=False)
    cluster = _nearest_cluster(cells, target)
    if len(cluster) < FEWEST_CELLS or np.abs(cluster - target).max() > REACH_M:
        raise ValueError("no object stands out from what surrounds it; say where it is with --box")
    return _grid(cluster, np.eye(4), config, on_plane=False)


def observed_region(
    depths_m: Sequence[NDArray[np.float32]],
    intrinsics: CameraIntrinsics,
    reference_from_camera: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The point (3,) nearest to all optical axes; where they are parallel, where they meet a surface.

    Raises:
        ValueError: no view has a return.
    """
    eyes, axes = reference_from_camera[:, :3, 3], reference_from_camera[:, :3, 2]
    met = []
    rows, columns = (slice(int(n * 0.4), int(n * 0.6) + 1) for n in (intrinsics.height, intrinsics.width))
    for depth, eye, axis in zip(depths_m, eyes, axes, strict=True):
        for middle in (depth[rows, columns], depth):
            returns = middle[middle != NO_RETURN]
            if len(returns):
                met.append(eye + np.quantile(returns, 0.3) * axis)
                break
    if not met:
        raise ValueError("no view has a depth return")
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    pull = 0.02 * len(eyes)
    matrix = across.sum(axis=0) + pull * np.eye(3)
    return np.linalg.solve(
        matrix, (across @ eyes[:, :, None]).sum(axis=0)[:, 0] + pull * np.median(met, axis=0)
    )


def place_of_pixel(pixel: tuple[float, float], intrinsics: CameraIntrinsics) -> tuple[int, int]:
    """Column and row of a pixel, whole numbers.

    Raises:
        ValueError: the pixel is outside the image.
    """
    column, row = (round(value) for value in pixel)
    if not (0 <= column < intrinsics.width and 0 <= row < intrinsics.height):
        raise ValueError(
            f"pixel {column},{row} is outside the image of {intrinsics.width}x{intrinsics.height}"
        )
    return column, row


def point_at_pixel(
    depth_m: NDArray[np.float32],
    intrinsics: CameraIntrinsics,
    reference_from_camera: NDArray[np.float64],
    pixel: tuple[float, float],
) -> NDArray[np.float64]:
    """The point (3,) that a frame shows at a pixel (column, row): the median depth of its neighbourhood.

    Raises:
        ValueError: the pixel is outside the image, or nothing returned near it.
    """
    column, row = place_of_pixel(pixel, intrinsics)
    rows, columns = (slice(max(n - PIXEL_REACH, 0), n + PIXEL_REACH + 1) for n in (row, column))
    returns = depth_m[rows, columns][depth_m[rows, columns] != NO_RETURN]
    if not len(returns):
        raise ValueError(f"nothing returned within {PIXEL_REACH} pixels of pixel {column},{row}")
    point = intrinsics.rays(column, row) * float(np.median(returns))
    return reference_from_camera[:3, :3] @ point + reference_from_camera[:3, 3]


def _standing_on(
    plane: Plane, cells: NDArray[np.float64], inside: NDArray[np.bool_], target: NDArray[np.float64]
) -> _Candidate | None:
    """What stands on a plane near the target, if the plane shows all round it and nothing below it."""
    heights = plane.heights(cells)
    cluster = _nearest_cluster(cells[inside & (heights > LEAST_HEIGHT_M)], target)
    if len(cluster) < FEWEST_CELLS:
        return None
    foot = cluster.mean(axis=0)
    basis = _basis(plane.normal)
    spread = (cluster - foot) @ basis.T
    radius = float(np.linalg.norm(spread, axis=1).max())
    flat = (cells - foot) @ basis.T
    distance = np.linalg.norm(flat, axis=1)
    sector = (
        np.floor((np.arctan2(flat[:, 1], flat[:, 0]) / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    )
    ring = distance < radius + RING_M
    shown = np.unique(sector[ring & (np.abs(heights) < INLIER_M)])
    below = ring & (heights < -LEAST_HEIGHT_M) & (heights > -STEP_M)
    if len(shown) < COVERED * SECTORS or below.sum() > 0.2 * len(cluster):
        return None
    return _Candidate(plane=plane, cluster=cluster)


def _nearest_cluster(cells: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """The connected cells whose nearest is closest to the target; tiny ones are passed over."""
    if len(cells) == 0:
        return cells
    index = np.floor((cells - cells.min(axis=0)) / CELL_M).astype(int)
    grid = np.zeros(index.max(axis=0) + 3, np.bool_)
    grid[tuple(index.T + 1)] = True
    connected = np.zeros(grid.shape, np.int32)
    ndimage.label(ndimage.binary_dilation(grid), np.ones((3, 3, 3)), output=connected)
    label = connected[tuple(index.T + 1)]
    sizes = np.bincount(label)
    distance = np.linalg.norm(cells - target, axis=1) + np.where(
        sizes[label] >= FEWEST_CELLS, 0.0, 10 * REACH_M
    )
    return cells[label == label[distance.argmin()]]


def _grid(
    points_m: NDArray[np.float64],
    reference_from_box: NDArray[np.float64],
    config: LearnConfig,
    *,
    on_plane: bool,
) -> VoxelGrid:
    """Grid round points (N, 3) along the axes of a frame; on a plane its lowest layer starts on z = 0."""
    local = (points_m - reference_from_box[:3, 3]) @ reference_from_box[:3, :3]
    margin = MARGIN_M + MARGIN_VOXELS * config.pitch_m
    low, high = local.min(axis=0) - margin, local.max(axis=0) + margin
    if on_plane:
        low[2] = 0.0
    shape = np.ceil((high - low) / config.pitch_m)
    if shape.prod() > LARGEST_GRID:
        size = " x ".join(f"{value:.2f}" for value in high - low)
        raise ValueError(
            f"the region of {size} m has {shape.prod():.0f} voxels of {config.pitch_m} m, more than "
            f"{LARGEST_GRID}: take a larger pitch or a smaller --box"
        )
    pose = reference_from_box.copy()
    pose[:3, 3] += pose[:3, :3] @ low
    i, j, k = (int(n) for n in shape)
    return VoxelGrid(shape=(i, j, k), pitch_m=config.pitch_m, reference_from_grid=pose, on_plane=on_plane)


def _upright(
    plane: Plane, points_m: NDArray[np.float64], reference_from_camera: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Frame (4, 4) on the plane under the points, z along its normal, x along the camera's right."""
    foot = points_m.mean(axis=0)
    right = reference_from_camera[:3, 0] - plane.normal * (plane.normal @ reference_from_camera[:3, 0])
    if np.linalg.norm(right) < 1e-3:
        right = _basis(plane.normal)[0]
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(plane.normal, right), plane.normal], axis=1)
    pose[:3, 3] = foot - plane.normal * plane.heights(foot)
    return pose


def _basis(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two unit vectors (2, 3) that span a plane."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first = np.asarray(first / np.linalg.norm(first), np.float64)
    return np.stack([first, np.cross(normal, first)])


def _cloud(
    depth_m: NDArray[np.float32], intrinsics: CameraIntrinsics, pose: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points (N, 3) of a thinned depth image in the reference frame."""
    stride = max(1, int(np.sqrt(depth_m.size / POINTS_PER_VIEW)))
    thinned = depth_m[::stride, ::stride]
    rows, columns = np.nonzero(thinned != NO_RETURN)
    points = intrinsics.rays(stride * columns, stride * rows) * thinned[rows, columns, None]
    return transform_points(pose, points)


def _averaged(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the points in every cell that holds two at least, which leaves out lone outliers."""
    if len(points_m) == 0:
        return points_m
    cells = np.floor((points_m - points_m.min(axis=0)) / CELL_M).astype(np.int64)
    number = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(axis=0) + 1))
    cell = np.unique(number, return_inverse=True)[1].reshape(-1)
    count = np.bincount(cell)
    means = np.stack([np.bincount(cell, points_m[:, axis]) / count for axis in range(3)], axis=1)
    return means[count >= 2]


def _within(
    points_m: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.bool_]:
    return np.all((points_m >= low) & (points_m <= high), axis=1)
