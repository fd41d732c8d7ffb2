"""The camera: its path with uncertainty, its particles, what it saw, and how sure the filter was."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.evaluation.trajectory_errors import largest_squared_distance
from pipeline.room import RoomView
from slam.result import SlamResult

ENLARGED = 10.0
"""Ellipsoids of uncertainty are drawn this much larger than they are."""
ELLIPSOIDS = 40
FRUSTA = 12

PATH_COLOUR = (255, 196, 64)
LOST_COLOUR = (235, 64, 52)
PARTICLE_COLOUR = (255, 196, 64, 40)
ELLIPSOID_COLOUR = (120, 200, 255, 90)
FRUSTUM_COLOUR = (110, 160, 255)


def log_room(recording: rr.RecordingStream, room: RoomView, radius_m: float) -> None:
    """The fused cloud, each point as a ball."""
    colours = room.rgb if room.rgb is not None else (150, 160, 175)
    recording.log("world/room", rr.Points3D(room.points_m, colors=colours, radii=radius_m), static=True)


def log_trajectory(recording: rr.RecordingStream, result: SlamResult) -> None:
    """The mean path, every particle's path, the 95% ellipsoids, and the camera along the frames."""
    centres = result.mean[:, :3, 3]
    recording.log("world/path/mean", rr.LineStrips3D([centres], colors=PATH_COLOUR, radii=0.004), static=True)
    particles = result.trajectories[:, :, :3, 3]
    recording.log(
        "world/path/particles",
        rr.LineStrips3D(list(particles), colors=PARTICLE_COLOUR, radii=0.0015),
        static=True,
    )
    if result.lost.any():
        lost = rr.Points3D(centres[result.lost], colors=LOST_COLOUR, radii=0.015)
        recording.log("world/path/lost", lost, static=True)
    _log_ellipsoids(recording, result)
    for frame, pose in enumerate(result.mean):
        recording.set_time("frame", sequence=frame)
        recording.set_time("time", timestamp=np.datetime64(int(result.times_ns[frame]), "ns"))
        recording.log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))


def log_camera_views(recording: rr.RecordingStream, result: SlamResult, room: RoomView) -> None:
    """Small depth and colour images at some frames, and frusta at a few of them."""
    height, width = room.depth_mm.shape[1:]
    fx, fy, cx, cy = room.intrinsics
    lens = {"focal_length": [fx, fy], "principal_point": [cx, cy], "width": width, "height": height}
    camera = rr.Pinhole(
        **lens, camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.12, color=PATH_COLOUR
    )
    recording.log("world/camera", camera, static=True)
    for view, frame in enumerate(room.frames):
        recording.set_time("frame", sequence=int(frame))
        recording.set_time("time", timestamp=np.datetime64(int(result.times_ns[frame]), "ns"))
        recording.log(
            "world/camera/depth", rr.DepthImage(room.depth_mm[view], meter=1000.0, colormap="turbo")
        )
        if room.view_rgb is not None:
            recording.log("world/camera/colour", rr.Image(room.view_rgb[view]))
    for frame in room.frames[:: -(-len(room.frames) // FRUSTA)]:
        pose = result.mean[frame]
        path = f"world/views/{frame:05d}"
        recording.log(path, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), static=True)
        frustum = rr.Pinhole(
            **lens, camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.07, color=FRUSTUM_COLOUR
        )
        recording.log(path, frustum, static=True)


def log_filter(recording: rr.RecordingStream, result: SlamResult) -> None:
    """Effective sample size, log evidence, share of the image explained, and standard deviations."""
    indexes = [
        rr.TimeColumn("frame", sequence=np.arange(len(result))),
        rr.TimeColumn("time", timestamp=result.times_ns.astype("datetime64[ns]")),
    ]
    position_mm = 1000 * np.sqrt(np.trace(result.covariance[:, :3, :3], axis1=1, axis2=2) / 3)
    rotation_deg = np.degrees(np.sqrt(np.trace(result.covariance[:, 3:, 3:], axis1=1, axis2=2) / 3))
    series = {
        "plots/ess": ("effective sample size", result.ess, (120, 220, 120)),
        "plots/evidence": ("log evidence a frame", result.log_evidence, (120, 180, 255)),
        "plots/position": ("position, mm", position_mm, (255, 196, 64)),
        "plots/rotation": ("rotation, degrees", rotation_deg, (230, 120, 220)),
    }
    for path, (name, values, colour) in series.items():
        recording.log(path, rr.SeriesLines(names=name, colors=colour, widths=1.5), static=True)
        recording.send_columns(path, indexes=indexes, columns=rr.Scalars.columns(scalars=values))


def _log_ellipsoids(recording: rr.RecordingStream, result: SlamResult) -> None:
    chosen = np.unique(np.linspace(0, len(result) - 1, min(ELLIPSOIDS, len(result))).round().astype(int))
    variances, axes = np.linalg.eigh(result.covariance[chosen, :3, :3])
    axes *= np.sign(np.linalg.det(axes))[:, None, None]
    turns = result.mean[chosen, :3, :3] @ axes
    radius = np.sqrt(largest_squared_distance(0.95, float(result.degrees_of_freedom), dimensions=3))
    half_sizes = ENLARGED * radius * np.sqrt(np.maximum(variances, 0))
    recording.log(
        "world/path/uncertainty",
        rr.Ellipsoids3D(
            centers=result.mean[chosen, :3, 3],
            half_sizes=half_sizes,
            quaternions=quaternions_xyzw(turns),
            colors=ELLIPSOID_COLOUR,
            fill_mode="solid",
        ),
        static=True,
    )


def quaternions_xyzw(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rerun's quaternions (N, 4) of rotations (N, 3, 3)."""
    return Rotation.from_matrix(rotations).as_quat()
