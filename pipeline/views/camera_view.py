"""What the camera saw and what the result says that it saw, at some frames; and the cloud fused from it."""

from __future__ import annotations

import numpy as np
import rerun as rr
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pipeline.colours import PATH, SKY_BLUE, shaded
from pipeline.publishing.values import RunValues
from pipeline.room import RoomView
from pipeline.views.rendered_depth import difference_rgb, rendered_views_mm
from pipeline.views.timelines import set_times
from pipeline.views.trajectory_view import THIN_WIDTH
from shapes.geometry.poses import transform_points
from shapes.prior import ShapePrior

SPACING_NEIGHBOURS = 4
LARGEST_RADIUS_M, RADIUS_AT_OBJECTS_M = 0.02, 0.0008
"""Points are as large as their neighbours are far, so that walls close; but small where objects were found or
learned, or their surfaces would vanish between them."""
BESIDE_OBJECTS_M = 0.02
"""Distance from an object's surface within which points count as being there."""
FRUSTUM_SHARE, FRUSTUM_DISTANCE = 0.08, 0.2
"""Of the path's extent: the length of the pyramids that show where the camera was, and their distance."""
LONGEST_FRUSTUM_M = 0.12
RADIUS_SHARE = 0.8
"""Of the distance to the fourth neighbour: balls touch on a flat grid."""
VOXELS_PERCENT = 10
"""Of the points have neighbours as near as the cloud was thinned to, at most: its voxels' edge."""
STRAY_SPACING = 3.0
"""Points so many times farther from their neighbours than pixels part there, and than voxels, are noise, and
drawn small. A surface seen at 70 degrees from its normal stays below."""


def log_room(recording: rr.RecordingStream, values: RunValues, room: RoomView) -> None:
    """The fused cloud, each point as a ball, shaded by normals where there is no colour."""
    colours = shaded(room.normals, values.up) if room.rgb is None else room.rgb
    radii = _radii_m(values, room)
    recording.log("world/room", rr.Points3D(room.points_m, colors=colours, radii=radii), static=True)


def log_camera_views(recording: rr.RecordingStream, values: RunValues, room: RoomView) -> tuple[float, float]:
    """Observed depth, rendered depth, their difference and colour, in the frames that were kept.

    Of photographs without depth, rendered depth and colour alone.

    Returns:
        Metres at which the colours of the depth images begin and end.
    """
    rendered_mm = rendered_views_mm(values, room)
    low_m, high_m = depth_range_m(room.depth_mm if room.has_depth else rendered_mm)
    for view, frame in enumerate(room.frames.tolist()):
        set_times(recording, frame, int(room.times_ns[view]), values.first_ns)
        depth_mm = {"rendered": rendered_mm[view]}
        if room.has_depth:
            depth_mm["depth"] = room.depth_mm[view]
            difference = difference_rgb(room.depth_mm[view], rendered_mm[view])
            recording.log("images/difference", rr.Image(difference))
        for name, pixels in depth_mm.items():
            image = rr.DepthImage(
                pixels, meter=1000.0, depth_range=[1000 * low_m, 1000 * high_m], colormap="turbo"
            )
            recording.log(f"images/{name}", image)
        if room.view_rgb is not None:
            recording.log("images/colour", rr.Image(room.view_rgb[view]))
    return low_m, high_m


def log_frusta(recording: rr.RecordingStream, values: RunValues, room: RoomView) -> None:
    """The camera as a pyramid: the one of the time looked at, and some along the path."""
    poses = _camera_poses(values, room)
    extent_m = float(np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)))
    length_m = float(np.clip(FRUSTUM_SHARE * extent_m, 0.02, LONGEST_FRUSTUM_M))
    height, width = room.depth_mm.shape[1:]
    fx, fy, cx, cy = room.intrinsics
    camera = rr.Pinhole(
        focal_length=[fx, fy],
        principal_point=[cx, cy],
        width=width,
        height=height,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=1.5 * length_m,
        color=PATH,
    )
    recording.log("world/camera", camera, static=True)
    corners = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]])
    rays = np.insert((corners - [cx, cy]) / [fx, fy], 2, 1.0, axis=1)
    strips = []
    for view in _far_apart(poses[:, :3, 3], FRUSTUM_DISTANCE * extent_m):
        tip, base = poses[view, :3, 3], length_m * rays @ poses[view, :3, :3].T + poses[view, :3, 3]
        strips += [[*base, base[0]], [base[0], tip, base[1]], [base[2], tip, base[3]]]
    frusta = rr.LineStrips3D(strips, colors=SKY_BLUE, radii=THIN_WIDTH)
    recording.log("world/path/views", frusta, static=True)


def point_radii_m(points_m: NDArray[np.float32], centres_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """Radii (N,) with which balls close the surfaces that the points (N, 3) are on, in metres.

    Args:
        points_m: a cloud.
        centres_m: (V, 3) where cameras were, in the same frame: pixels part with distance.
    """
    if len(points_m) <= SPACING_NEIGHBOURS:
        return np.full(len(points_m), LARGEST_RADIUS_M, np.float32)
    spacing_m = KDTree(points_m).query(points_m, k=SPACING_NEIGHBOURS + 1)[0][:, -1]
    range_m = KDTree(centres_m).query(points_m)[0]
    usual_m = np.maximum(np.percentile(spacing_m, VOXELS_PERCENT), np.median(spacing_m / range_m) * range_m)
    spacing_m = np.where(spacing_m > STRAY_SPACING * usual_m, usual_m, spacing_m)
    return np.minimum(RADIUS_SHARE * spacing_m, LARGEST_RADIUS_M).astype(np.float32)


def depth_range_m(depth_mm: NDArray[np.uint16]) -> tuple[float, float]:
    """Where most of the depth of images (V, h, w) lies, by which they are coloured; metres."""
    seen = depth_mm[depth_mm > 0]
    if not len(seen):
        return 0.0, 1.0
    low, high = np.percentile(seen[:: max(len(seen) // 100_000, 1)], [1, 98]) / 1000
    return float(low), float(max(high, low + 0.01))


def _camera_poses(values: RunValues, room: RoomView) -> NDArray[np.float64]:
    """Of the frames that were kept (V, 4, 4); the one pose where the run has no path."""
    return np.eye(4)[None] if values.slam is None else values.slam.mean[room.frames]


def _radii_m(values: RunValues, room: RoomView) -> NDArray[np.float32]:
    """Of the balls that stand for the points of the cloud, small at what was found or learned."""
    radii = point_radii_m(room.points_m, _camera_poses(values, room)[:, :3, 3])
    for shape in values.shapes.values():
        radii[_in_box(shape, room.points_m)] = RADIUS_AT_OBJECTS_M
    if values.scene is not None and values.surfaces is not None:
        for name, pose in values.scene.found_poses:
            posed = values.reference_from_parsed @ pose
            one = values.surfaces.by_name[name]
            close_m = trimesh.remesh.subdivide_to_size(one.vertices_m, one.faces, BESIDE_OBJECTS_M)[0]
            surface = transform_points(posed, close_m)
            beside = KDTree(surface).query(room.points_m, distance_upper_bound=BESIDE_OBJECTS_M)[0]
            radii[np.isfinite(beside)] = RADIUS_AT_OBJECTS_M
    return radii


def _in_box(shape: ShapePrior, points_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which points (N, 3) of the reference frame lie in the box of what is solid of a shape, or touch it."""
    if not shape.solid.any():
        return np.zeros(len(points_m), np.bool_)
    low, high = shape.bounding_box_m
    from_grid = shape.reference_from_grid
    local = (points_m - from_grid[:3, 3]) @ from_grid[:3, :3]
    return ((local >= low - shape.pitch_m) & (local <= high + shape.pitch_m)).all(axis=1)


def _far_apart(centres_m: NDArray[np.float64], distance_m: float) -> list[int]:
    """The first of the centres (V, 3), and each that is so far from the one chosen before it."""
    chosen = [0]
    for view in range(1, len(centres_m)):
        if np.linalg.norm(centres_m[view] - centres_m[chosen[-1]]) >= max(distance_m, 1e-3):
            chosen.append(view)
    return chosen
