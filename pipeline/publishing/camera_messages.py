"""The camera in run.mcap: its transform in every frame, its path, its particles and what it saw."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from numpy.typing import NDArray

from pipeline.colours import LOST, PATH
from pipeline.publishing.foxglove_geometry import (
    MAP,
    REFERENCE,
    frame_transform,
    point_cloud,
    quaternions,
    set_colour,
    set_quaternion,
    set_vector,
)
from pipeline.publishing.values import RunValues
from pipeline.room import RoomView
from shapes.geometry.poses import matrices_of
from slam.result import SlamResult

VIEW = "voxscene_view"
"""Frame of the thinned images, where the recording's own is: each keeps a calibration of its own."""
PATH_WIDTH_M = 0.006
PATH_STEP_M = 0.003
"""Between points of the path's cloud, so that it looks like a line."""


def static_transform(values: RunValues) -> FrameTransform:
    """Between the map, whose z axis points up, and the run's reference frame."""
    map_from_reference = np.eye(4)
    map_from_reference[:3, :3] = level_from_reference(values.up)
    if values.camera_frame_has_parent:
        return frame_transform(REFERENCE, MAP, np.linalg.inv(map_from_reference))
    return frame_transform(MAP, REFERENCE, map_from_reference)


def camera_transforms(values: RunValues) -> Iterator[tuple[int, FrameTransform]]:
    """Stamps and transforms between the reference frame and the recording's own frame of the camera.

    A frame has one parent. Where the recording says where its camera's frame is, the reference hangs below
    that frame and not above it, so that the recording and run.mcap, opened together, are one tree.
    """
    camera_from_frame = np.linalg.inv(values.frame_from_camera)
    for time_ns, reference_from_camera in values.stamped_poses():
        pose = reference_from_camera @ camera_from_frame
        if values.camera_frame_has_parent:
            yield time_ns, frame_transform(values.camera_frame, REFERENCE, np.linalg.inv(pose))
        else:
            yield time_ns, frame_transform(REFERENCE, values.camera_frame, pose)


def view_transform(values: RunValues) -> FrameTransform:
    """From the recording's frame of the camera to the frame of the thinned images, which look along z."""
    return frame_transform(values.camera_frame, VIEW, values.frame_from_camera)


def level_from_reference(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation (3, 3) that turns a unit vector up (3,) into +z, and the camera's view into the x-z plane."""
    ahead = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.95 else np.array([0.0, -1.0, 0.0])
    forward = ahead - (ahead @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack([forward, np.cross(up, forward), up])


def path_update(result: SlamResult) -> SceneUpdate:
    """The mean path as a line, and the frames that were lost as points of it in another colour."""
    update = SceneUpdate()
    entity = update.entities.add(frame_id=REFERENCE, id="path")
    line = entity.lines.add(type=LinePrimitive.LINE_STRIP, thickness=PATH_WIDTH_M)
    line.pose.orientation.w = 1.0
    set_colour(line.color, PATH)
    for centre, lost in zip(result.mean[:, :3, 3], result.lost, strict=True):
        set_vector(line.points.add(), centre)
        set_colour(line.colors.add(), LOST if lost else PATH)
    return update


def path_points(result: SlamResult) -> Any:
    """The mean path as a cloud, for viewers that draw no lines."""
    centres = result.mean[:, :3, 3]
    if len(centres) == 1:
        points, at = centres, np.zeros(1, int)
    else:
        steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
        counts = np.maximum(np.ceil(steps / PATH_STEP_M).astype(int), 1)
        at = np.repeat(np.arange(len(steps)), counts)
        share = (np.arange(len(at)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[at]
        points = centres[at] + share[:, None] * np.diff(centres, axis=0)[at]
    rgb = np.where(result.lost[at, None], np.array(LOST), np.array(PATH)).astype(np.uint8)
    return point_cloud(REFERENCE, points, rgb)


def particles_of(result: SlamResult, frame: int) -> PosesInFrame:
    """Where each particle has the camera in a frame."""
    message = PosesInFrame(frame_id=REFERENCE)
    poses = matrices_of(result.draws[:, frame])
    for pose, xyzw in zip(poses, quaternions(poses), strict=True):
        particle = message.poses.add()
        set_vector(particle.position, pose[:3, 3])
        set_quaternion(particle.orientation, xyzw)
    return message


def view_messages(room: RoomView) -> Iterator[tuple[int, str, Any]]:
    """Stamps, topics and messages of the thinned images, with the camera that they are of."""
    height, width = room.depth_mm.shape[1:]
    fx, fy, cx, cy = room.intrinsics.tolist()
    frame = VIEW
    for view, stamp in enumerate(room.times_ns.tolist()):
        yield (
            stamp,
            "/camera/calibration",
            CameraCalibration(
                frame_id=frame,
                width=width,
                height=height,
                distortion_model="plumb_bob",
                D=[0.0] * 5,
                K=[fx, 0, cx, 0, fy, cy, 0, 0, 1],
                R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
                P=[fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
            ),
        )
        yield stamp, "/camera/depth", _image(frame, "16UC1", room.depth_mm[view].astype("<u2"))
        if room.view_rgb is not None:
            yield stamp, "/camera/color", _image(frame, "rgb8", room.view_rgb[view])


def _image(frame: str, encoding: str, pixels: NDArray) -> RawImage:
    height, width = pixels.shape[:2]
    return RawImage(
        frame_id=frame,
        width=width,
        height=height,
        encoding=encoding,
        step=pixels.nbytes // height,
        data=pixels.tobytes(),
    )
