"""What the camera saw of the room: a fused point cloud and a few small views, for looking and for export."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from recordings.types import NO_RETURN, CameraIntrinsics, Frame
from shapes.archive import load_arrays, save_arrays

VOXEL_M = 0.01
"""Points closer than this are fused into their mean; single ones are left out."""
FUSED_FRAMES = 60
"""Frames that are fused, evenly spread."""
POINTS_PER_FRAME = 40_000
NEIGHBOURS = 30
"""Points to which a plane is fitted for a normal: three rings round a point of a flat grid."""
FEW, FINE_VOXEL_M = 1, 0.004
"""Of so few frames the points are kept closer together, and single ones too: there is little to fuse."""
MOST_POINTS = 400_000
UNSEEN_GREY = 128
"""Of points that no colour image shows, where others have a colour."""
VIEW_WIDTH = 160
"""Width to which the kept views are thinned."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RoomView:
    """A fused cloud in the run's reference frame, and views from which it was fused.

    Attributes:
        points_m: (N, 3) float32.
        normals: (N, 3) int8, 127 times the unit normal on the side from which the point was seen.
        rgb: (N, 3) uint8, `UNSEEN_GREY` where no colour image shows a point; None without colour.
        frames: (V,) int32 indices of the views in the recording.
        times_ns: (V,) int64 stamps of the views.
        depth_mm: (V, h, w) uint16 thinned depth images, 0 where nothing returned.
        view_rgb: (V, h, w, 3) uint8, or None without colour.
        intrinsics: (4,) fx, fy, cx, cy in pixels of the thinned images.
        frame_id: () str, the recording's own name of the camera's frame.
        frame_has_parent: () bool, whether the recording says where that frame is.
        frame_from_camera: (4, 4) the camera, which looks along z, in that frame: a cloud's may look along x.
    """

    points_m: NDArray[np.float32]
    normals: NDArray[np.int8]
    rgb: NDArray[np.uint8] | None
    frames: NDArray[np.int32]
    times_ns: NDArray[np.int64]
    depth_mm: NDArray[np.uint16]
    view_rgb: NDArray[np.uint8] | None
    intrinsics: NDArray[np.float64]
    frame_id: NDArray[np.str_]
    frame_has_parent: NDArray[np.bool_]
    frame_from_camera: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    @property
    def has_depth(self) -> bool:
        """Whether anything was measured; not in photographs."""
        return bool(self.depth_mm.any())

    def save(self, path: Path) -> None:
        """Write an npz file, whole or not at all; equal views give equal bytes."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        save_arrays(path, {name: array for name, array in arrays.items() if array is not None})

    @classmethod
    def load(cls, path: Path) -> RoomView:
        """Read what `save` wrote.

        Raises:
            PipelineError: the file is damaged.
        """
        try:
            arrays = load_arrays(path)
            return cls(**{"rgb": None, "view_rgb": None, **arrays})  # type: ignore[arg-type]
        except (ValueError, TypeError) as error:
            raise PipelineError(f"{path} is damaged: {error}") from error


def view_room(
    frames: Iterable[Frame],
    intrinsics: CameraIntrinsics,
    reference_from_camera: NDArray[np.float64],
    progress: Callable[[int, int], None] | None = None,
    *,
    lost: NDArray[np.bool_] | None = None,
    frame_id: str = "",
    frame_has_parent: bool = False,
    frame_from_camera: NDArray[np.float64] | None = None,
) -> RoomView:
    """Fuse frames at known poses (T, 4, 4), one pose for each frame.

    Args:
        frames: of the recording.
        intrinsics: of their camera.
        reference_from_camera: the poses.
        progress: told frames done and frames in all.
        lost: (T,) frames whose poses are guesses: they may be views, but nothing of them is fused.
        frame_id: the recording's name of the camera's frame, `camera` where it has none.
        frame_has_parent: whether the recording says where that frame is.
        frame_from_camera: the camera in that frame, (4, 4); by default they are the same.
    """
    count = len(reference_from_camera)
    chosen = np.unique(np.linspace(0, count - 1, min(FUSED_FRAMES, count)).round().astype(int))
    wanted = set(chosen.tolist())
    step = -(-intrinsics.width // VIEW_WIDTH)
    cloud = _Cloud(*((FINE_VOXEL_M, 1) if count <= FEW else (VOXEL_M, 2)))
    stamps, depths, colours = [], [], []
    for index, frame in enumerate(frames):
        if index in wanted:
            if lost is None or not lost[index]:
                cloud.add(frame, intrinsics, reference_from_camera[index])
            stamps.append(frame.time_ns)
            depths.append(np.round(1000 * np.minimum(frame.depth_m[::step, ::step], 65.0)).astype(np.uint16))
            if frame.rgb is not None:
                colours.append(frame.rgb[::step, ::step])
        if progress:
            progress(index + 1, count)
    points, normals, rgb = cloud.fused()
    coloured = len(colours) == len(depths)
    return RoomView(
        points_m=points,
        normals=normals,
        rgb=rgb,
        frames=chosen.astype(np.int32),
        times_ns=np.array(stamps, np.int64),
        depth_mm=np.stack(depths),
        view_rgb=np.stack(colours) if coloured else None,
        intrinsics=np.array([intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]) / step,
        frame_id=np.array(frame_id or "camera"),
        frame_has_parent=np.array(frame_has_parent),
        frame_from_camera=np.eye(4) if frame_from_camera is None else frame_from_camera,
    )


class _Cloud:
    """Sums of points and colours by voxel.

    Args:
        voxel_m: edge of a voxel.
        least: points that a voxel must hold to count.
    """

    def __init__(self, voxel_m: float, least: int) -> None:
        self._voxel_m, self._least = voxel_m, least
        self._points = [np.zeros((0, 3), np.float32)]
        self._sights = [np.zeros((0, 3), np.float32)]
        self._colours = [np.zeros((0, 4), np.float32)]

    def add(
        self, frame: Frame, intrinsics: CameraIntrinsics, reference_from_camera: NDArray[np.float64]
    ) -> None:
        """Add the points of a frame, thinned evenly."""
        v, u = np.nonzero(frame.depth_m != NO_RETURN)
        stride = -(-len(u) // POINTS_PER_FRAME) or 1
        u, v = u[::stride], v[::stride]
        local = intrinsics.rays(u, v) * frame.depth_m[v, u, None]
        self._points.append(
            (local @ reference_from_camera[:3, :3].T + reference_from_camera[:3, 3]).astype(np.float32)
        )
        self._sights.append((local @ reference_from_camera[:3, :3].T).astype(np.float32))
        colours = np.zeros((len(u), 4), np.float32)  # red, green, blue, and whether they are known
        if frame.rgb is not None:
            known = np.ones(len(u), np.bool_) if frame.rgb_known is None else frame.rgb_known[v, u]
            colours[known, :3], colours[known, 3] = frame.rgb[v, u][known], 1
        self._colours.append(colours)

    def fused(self) -> tuple[NDArray[np.float32], NDArray[np.int8], NDArray[np.uint8] | None]:
        """Means over voxels that enough points fell into, normals, and colours if any point has one."""
        points = np.concatenate(self._points)
        if not len(points):
            return points, np.zeros((0, 3), np.int8), None
        values = np.concatenate([points, np.concatenate(self._sights), np.concatenate(self._colours)], axis=1)
        cell = np.floor((points - points.min(axis=0)) / self._voxel_m).astype(np.int64)
        voxel, counts = _numbered(cell)
        sums = np.stack([np.bincount(voxel, column) for column in values.T.astype(np.float64)], axis=-1)
        enough = counts >= self._least
        thinned = slice(None, None, -(-int(enough.sum()) // MOST_POINTS) or 1)
        sums, counts = sums[enough][thinned], counts[enough][thinned]
        means = (sums[:, :3] / counts[:, None]).astype(np.float32)
        normals = _normals(means, sums[:, 3:6].astype(np.float64))
        seen = sums[:, 9]
        if not seen.any():
            return means, normals, None
        rgb = np.where(seen[:, None] > 0, sums[:, 6:9] / np.maximum(seen, 1)[:, None], UNSEEN_GREY)
        return means, normals, rgb.round().astype(np.uint8)


def _numbered(cell: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers (N,) of the cells of a grid, (N, 3) and not negative, among those in use; points in each.

    One axis after the other: of points kilometres apart, 64 bits do not number all cells between them.
    """
    number = counts = np.zeros(len(cell), np.int64)
    for column in cell.T:
        along = number * (int(column.max()) + 1) + column
        _, number, counts = np.unique(along, return_inverse=True, return_counts=True)
    return number, counts


def _normals(points_m: NDArray[np.float32], sights: NDArray[np.float64]) -> NDArray[np.int8]:
    """Of planes through the neighbours of each point (N, 3), against the way from the camera to it."""
    import open3d as o3d

    if not len(points_m):
        return np.zeros((0, 3), np.int8)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m.astype(np.float64)))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
    normals = np.asarray(cloud.normals)
    normals *= -np.sign((normals * sights).sum(axis=1, keepdims=True))
    return (127 * normals).round().astype(np.int8)
