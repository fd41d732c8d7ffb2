"""What the result says that the camera saw, beside what it saw: rendered depth and differences."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from pipeline.publishing.values import RunValues
from pipeline.room import RoomView
from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics

SPLAT_POINTS = 80_000
"""Of the map that are projected into each view, which has a fourth as many pixels."""
SAME_SURFACE_M = 0.03
"""Points of a pixel so little behind its nearest one are averaged with it, which alone would be too near."""
SEEN_THROUGH_M = 0.06
"""A pixel so far behind one beside it shows what lies behind a surface with gaps: the gap is closed."""
DIFFERENCE_MM = 20.0
"""Difference at which the colours of the difference image end."""
NEARER, FARTHER, SAME = (0, 114, 178), (213, 94, 0), (235, 235, 235)
"""Blue, vermilion (Okabe and Ito) and white: the ends and the middle of the scale of differences."""
NOTHING = (30, 32, 38)


def rendered_views_mm(values: RunValues, room: RoomView) -> NDArray[np.uint16]:
    """Depth (V, h, w) of what the run knows in each of the room's views, 0 where it knows nothing.

    Of a parsed scene these are the objects that were found; else the map, fused from all views.
    """
    poses = _view_poses(values, room)
    caster = _objects(values)
    if caster is not None:
        camera = view_camera(room)
        depth = np.stack([caster.view(camera, pose).depth_m for pose in poses])
        return np.where(np.isfinite(depth), np.round(1000 * np.minimum(depth, 65.0)), 0).astype(np.uint16)
    points = room.points_m[:: -(-len(room.points_m) // SPLAT_POINTS) or 1]
    return np.stack([_splat_mm(points, pose, room) for pose in poses])


def difference_rgb(observed_mm: NDArray[np.uint16], rendered_mm: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Observed minus rendered (h, w) in colours (h, w, 3): blue nearer, white alike, vermilion farther."""
    both = (observed_mm > 0) & (rendered_mm > 0)
    signed = np.clip((observed_mm.astype(float) - rendered_mm) / DIFFERENCE_MM, -1, 1)
    return np.where(both[..., None], difference_colours(signed), np.array(NOTHING)).astype(np.uint8)


def difference_colours(signed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Colours (..., 3) of differences (...) as shares of `DIFFERENCE_MM`."""
    end = np.where(signed[..., None] < 0, np.array(NEARER), np.array(FARTHER))
    share = np.abs(signed)[..., None]
    return (1 - share) * np.array(SAME) + share * end


def view_camera(room: RoomView) -> CameraIntrinsics:
    """The camera of the room's thinned views."""
    height, width = room.depth_mm.shape[1:]
    fx, fy, cx, cy = room.intrinsics.tolist()
    return CameraIntrinsics(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def _view_poses(values: RunValues, room: RoomView) -> NDArray[np.float64]:
    """reference_from_camera (V, 4, 4) of the views; without a trajectory there is one, the reference."""
    return np.eye(4)[None] if values.slam is None else values.slam.mean[room.frames]


def _objects(values: RunValues) -> RayCaster | None:
    """The objects that were found, in the reference frame."""
    if values.scene is None or values.surfaces is None or not values.scene.found.any():
        return None
    parts = []
    for name, pose in values.scene.found_poses:
        surface = values.surfaces.by_name[name]
        mesh = trimesh.Trimesh(surface.vertices_m, surface.faces, process=False)
        parts.append(Part(name=name, mesh=mesh, world_from_part=values.reference_from_parsed @ pose))
    return RayCaster(parts)


def _splat_mm(
    points_m: NDArray[np.float32], reference_from_camera: NDArray[np.float64], room: RoomView
) -> NDArray[np.uint16]:
    """Depth (h, w) of the nearest points of a cloud (N, 3) in each pixel, 0 without."""
    height, width = room.depth_mm.shape[1:]
    fx, fy, cx, cy = room.intrinsics
    turn = reference_from_camera[:3, :3].astype(np.float32)
    local = (points_m - reference_from_camera[:3, 3].astype(np.float32)) @ turn
    local = local[local[:, 2] > 0.05]
    u = np.rint(fx * local[:, 0] / local[:, 2] + cx)
    v = np.rint(fy * local[:, 1] / local[:, 2] + cy)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    pixel, depth = (v[inside] * width + u[inside]).astype(int), local[inside, 2]
    nearest = np.full(height * width, np.inf)
    np.minimum.at(nearest, pixel, depth)
    front = depth < nearest[pixel] + SAME_SURFACE_M
    count = np.bincount(pixel[front], minlength=height * width)
    mean = np.bincount(pixel[front], depth[front], minlength=height * width) / np.maximum(count, 1)
    mean = np.where(count > 0, mean, np.inf).reshape(height, width)
    before = minimum_filter(mean, size=3)
    shown = np.where(mean > before + SEEN_THROUGH_M, before, mean)
    millimetres = 1000 * np.minimum(np.where(np.isfinite(shown), shown, 0.0), 65.0)
    return np.round(millimetres).astype(np.uint16)
