"""What a camera saw of every cell of a grid: a surface that waits for an object, free space, or nothing.

Cells lie in the axes of the table, in the camera's without one. A cell's evidence is +1 where a foreground
point was measured in it, -FREE where every ray through it went on farther or it lies below the table, 0
where nobody looked or something else explains what was seen.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from recordings.types import NO_RETURN
from scene.observation.depth_view import unproject
from scene.observation.frame_data import SceneData

PITCH_M = 0.008
"""Edge of the finer cells, half the 16 mm of the coarser ones: ICP corrects what lies within a centimetre."""

STEPS = 10
"""Evidence is stored in tenths, for sums of it to be exact integers."""

FREE = 7
"""Steps of evidence against a surface where space was seen free; 0 is the plain cloud of the supplement."""

FREE_CELLS = 1.2
"""Cells by which a ray must go on behind a cell's centre: its half diagonal, and the sensor's error."""

BELOW_CELLS = 6
"""Layers of the grid below the table, 5 cm: what sinks deeper has lost its score in them."""

MOST_CELLS = 2**22
"""Beyond so many, 4 MiB, cells are enlarged."""

LARGER = 1.5

COMPANY = 3
"""Points of a cell; where two surfaces are 2.5 m away a cell of 16 mm has a dozen."""

_log = logging.getLogger("voxscene.masks")


@dataclass(frozen=True, kw_only=True, eq=False)
class EvidenceGrid:
    """Evidence of cells, and where they are.

    Attributes:
        evidence: (X, Y, Z) int8, in STEPS; even numbers of cells.
        pitch_m: edge of a cell.
        camera_from_grid: (4, 4); the grid's origin is the outer corner of cell (0, 0, 0).
    """

    evidence: NDArray[np.int8]
    pitch_m: float
    camera_from_grid: NDArray[np.float64]

    def coarser(self) -> EvidenceGrid:
        """The grid of cells twice as large: a surface where any part shows one, free where all parts are."""
        x, y, z = (np.array(self.evidence.shape) // 2).tolist()
        evidence = self.evidence.reshape(x, 2, y, 2, z, 2).max(axis=(1, 3, 5))
        return EvidenceGrid(
            evidence=evidence, pitch_m=2 * self.pitch_m, camera_from_grid=self.camera_from_grid
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenSpace:
    """What is the same for all objects of a frame: which cells are free, and in which cells points lie.

    Attributes:
        free: (X, Y, Z) bool.
        cells: (H, W, 3) int, the cell of every pixel's point; -1 beside the grid.
        pitch_m: edge of a cell.
        camera_from_grid: (4, 4).
    """

    free: NDArray[np.bool_]
    cells: NDArray[np.int64]
    pitch_m: float
    camera_from_grid: NDArray[np.float64]

    def waiting(self, unexplained: NDArray[np.bool_]) -> EvidenceGrid:
        """The evidence for an object that pixels (H, W) of the foreground may show."""
        evidence = np.where(self.free, np.int8(-FREE), np.int8(0))
        cells = self.cells[unexplained & (self.cells[..., 0] >= 0)]
        evidence[tuple(cells.T)] = STEPS
        return EvidenceGrid(evidence=evidence, pitch_m=self.pitch_m, camera_from_grid=self.camera_from_grid)


def seen_space(data: SceneData, radius_m: float) -> SeenSpace | None:
    """The cells round a frame's foreground, as far as an object may reach; None without a foreground.

    Where there would be too many they are enlarged, which is told in the log.

    Args:
        data: the frame.
        radius_m: of the largest object.
    """
    if not (data.near.any() and data.foreground.any()):
        return None
    camera_from_axes = data.table.camera_from_table if data.table else np.eye(4)
    rotation, origin_m = camera_from_axes[:3, :3], camera_from_axes[:3, 3]
    shown_m = (unproject(data.depth_m, data.intrinsics)[data.near] - origin_m) @ rotation
    pitch_m = PITCH_M
    shown_m = _in_company(shown_m, 2 * pitch_m)
    low_m, high_m = shown_m.min(axis=0) - radius_m, shown_m.max(axis=0) + radius_m
    low_m, size = _bounds(low_m, high_m, pitch_m, data)
    while size.prod() > MOST_CELLS:
        pitch_m *= LARGER
        _log.warning("the foreground is wide: masks are sought in cells of %.0f mm", 1000 * pitch_m)
        low_m, size = _bounds(low_m, high_m, pitch_m, data)
    camera_from_grid = camera_from_axes.copy()
    camera_from_grid[:3, 3] += rotation @ low_m
    cells = np.floor(((data.view.points_m - origin_m) @ rotation - low_m) / pitch_m).astype(np.int64)
    cells[((cells < 0) | (cells >= size)).any(axis=-1)] = -1
    free = _carved(data, size, pitch_m, camera_from_grid)
    if data.table:
        free[:, :, :BELOW_CELLS] = True
    return SeenSpace(free=free, cells=cells, pitch_m=pitch_m, camera_from_grid=camera_from_grid)


def _in_company(points_m: NDArray[np.float64], edge_m: float) -> NDArray[np.float64]:
    """Points (N, 3) that share a cell with some others, all if none does: strays must not widen the grid."""
    _, cell, count = np.unique(cell_numbers(points_m, edge_m), return_inverse=True, return_counts=True)
    accompanied = count[cell] >= COMPANY
    return points_m[accompanied] if accompanied.any() else points_m


def cell_numbers(points_m: NDArray[np.floating], edge_m: float) -> NDArray[np.intp]:
    """Number (N,) of the cube of this edge in which each of points (N, 3) lies, the same for those in one."""
    cells = np.floor(points_m / edge_m).astype(np.int64)
    cells -= cells.min(axis=0)
    return np.asarray(np.ravel_multi_index(tuple(cells.T), cells.max(axis=0) + 1))


def _bounds(
    low_m: NDArray[np.float64], high_m: NDArray[np.float64], pitch_m: float, data: SceneData
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The grid's corner (3,), with a table some layers below it, and even numbers of cells (3,)."""
    if data.table:
        low_m = np.append(low_m[:2], -BELOW_CELLS * pitch_m)
    return low_m, 2 * np.ceil((high_m - low_m) / (2 * pitch_m)).astype(np.int64)


def _carved(
    data: SceneData,
    size: Sequence[int] | NDArray[np.int64],
    pitch_m: float,
    camera_from_grid: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Cells (X, Y, Z) behind which every ray through them was measured."""
    camera, depth_m = data.view.camera, np.asarray(data.view.depth_m)
    columns = (camera_from_grid[:3, :3] * pitch_m).astype(np.float32)
    steps = [np.arange(count, dtype=np.float32) + np.float32(0.5) for count in size]
    x, y, z = (
        np.float32(camera_from_grid[axis, 3])
        + (columns[axis, 0] * steps[0])[:, None, None]
        + (columns[axis, 1] * steps[1])[None, :, None]
        + (columns[axis, 2] * steps[2])[None, None, :]
        for axis in range(3)
    )
    z = np.maximum(z, np.float32(1e-3))
    column = np.floor(x / z * np.float32(camera.fx) + np.float32(camera.cx + 0.5)).astype(np.int32)
    row = np.floor(y / z * np.float32(camera.fy) + np.float32(camera.cy + 0.5)).astype(np.int32)
    height, width = depth_m.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    nearest_m = _nearest_through(depth_m, data.foreground, pitch_m * float(camera.fx))
    place = np.where(inside, row * width + column, 0)
    return inside & (nearest_m.ravel()[place] > z + np.float32(FREE_CELLS * pitch_m))


def _nearest_through(
    depth_m: NDArray[np.float32], foreground: NDArray[np.bool_], pitch_px_m: float
) -> NDArray[np.float32]:
    """The least depth (H, W) of the rays that meet a cell round a pixel; 0 where one measured nothing."""
    distance_m = float(np.median(depth_m[foreground]))
    across = 2 * int(np.ceil(pitch_px_m / distance_m / 2)) + 1
    return np.asarray(minimum_filter(np.where(depth_m == NO_RETURN, 0, depth_m), across), np.float32)
