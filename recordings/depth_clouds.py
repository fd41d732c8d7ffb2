"""Depth from point cloud topics, for recordings without depth images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.cameras.matching import is_frame, matching_camera
from recordings.cameras.pinhole import UnusableCamera, stored_intrinsics
from recordings.depth_topics import DepthTopic
from recordings.images.depth_pixels import MAX_PIXELS, MetricDepth
from recordings.images.point_clouds import (
    OPTICAL_FROM_BODY,
    looks_along_x,
    pinhole_of_grid,
    points_of,
    projected,
    share_in_view,
    virtual_camera,
)
from recordings.messages.types import CameraMessage, DecodedMessage, PointCloudMessage, UndecodableMessage
from recordings.options import ReadOptions
from recordings.types import CameraIntrinsics


class DepthClouds:
    """Turns the messages of a point cloud topic into depth images of one pinhole camera.

    An organised cloud whose rows and columns are a pinhole camera's pixels is taken as that camera's
    image. Any other is projected: into the camera that the user gives, the camera recorded in the same
    frame, or a virtual one that sees the first cloud.

    Args:
        topic: the topic.
        cameras: a usable message of each camera topic.
        options: what the user says.

    Attributes:
        is_projected: whether the clouds are no camera's pixels.
        share_in_view: of the first cloud's points, those that its depth image is made from; the others lie
            beside the camera or behind it.

    Raises:
        UndecodableMessage: the first cloud shows nothing to place a virtual camera by.
    """

    def __init__(self, topic: DepthTopic, cameras: dict[str, CameraMessage], options: ReadOptions) -> None:
        assert isinstance(topic.first, PointCloudMessage)
        first = topic.first
        self._metric = MetricDepth(options.depth_scale_m)
        self.camera_topic: str | None = None
        self.camera_problem = None
        points = points_of(first)
        grid = pinhole_of_grid(points)
        self._grid_size = None if grid is None else (grid.width, grid.height)
        along_x = grid is None and looks_along_x(first.frame_id, points)
        self.frame_from_camera = np.linalg.inv(OPTICAL_FROM_BODY) if along_x else np.eye(4)
        if options.intrinsics is not None:
            self.intrinsics = _fitting(_given(options.intrinsics, self._grid_size))
        elif grid is not None:
            self.intrinsics = grid
        else:
            recorded = self._recorded_camera(topic, cameras)
            self.intrinsics = _fitting(recorded) if recorded else virtual_camera(self._optical(points))
        self.is_projected = grid is None
        self.share_in_view = share_in_view(self._optical(points), self.intrinsics) if grid is None else 1.0

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the depth images."""
        return self.intrinsics.width, self.intrinsics.height

    def stored(self, message: DecodedMessage) -> NDArray[np.float32]:
        """The depth image (H, W) of one cloud in the cloud's own unit.

        Raises:
            UndecodableMessage: the message is damaged, or has lost the grid of the first.
        """
        if not isinstance(message, PointCloudMessage):
            raise UndecodableMessage("is no point cloud")
        points = points_of(message)
        if self._grid_size is None:
            return projected(self._optical(points), self.intrinsics)
        if (message.width, message.height) != self._grid_size:
            raise UndecodableMessage(f"has {message.width}x{message.height} points, not the first's number")
        return points[..., 2]

    def metres(self, stored: NDArray, _time_ns: int) -> NDArray[np.float32]:
        """The depth image (H, W) in metres of stored numbers."""
        return self._metric(stored)

    def depth(self, message: DecodedMessage, time_ns: int) -> NDArray[np.float32]:
        """The depth image (H, W) in metres of one cloud.

        Raises:
            UndecodableMessage: the message is damaged, or has lost the grid of the first.
        """
        return self.metres(self.stored(message), time_ns)

    def _optical(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        with np.errstate(invalid="ignore"):  # infinite coordinates stand for no return
            return points.reshape(-1, 3) @ self.frame_from_camera[:3, :3].astype(np.float32)

    def _recorded_camera(
        self, topic: DepthTopic, cameras: dict[str, CameraMessage]
    ) -> CameraIntrinsics | None:
        """A camera in the cloud's own frame; None where there is none, or nobody knows which."""
        frame_id = topic.first.frame_id
        same_frame = {name: camera for name, camera in cameras.items() if is_frame(camera.frame_id, frame_id)}
        try:
            found = matching_camera(topic.name, frame_id, (0, 0), same_frame)
            if found is None:
                return None
            camera_topic, camera = found
            intrinsics = stored_intrinsics(camera, camera.width, camera.height, rectified=True)
        except UnusableCamera:
            return None
        self.camera_topic = camera_topic
        return intrinsics


def _fitting(camera: CameraIntrinsics) -> CameraIntrinsics:
    """The same camera.

    Raises:
        UndecodableMessage: its image is larger than memory is taken for.
    """
    if camera.width * camera.height > MAX_PIXELS:
        raise UndecodableMessage(f"has a camera that claims images of {camera.width}x{camera.height} pixels")
    return camera


def _given(intrinsics: tuple[float, float, float, float], size: tuple[int, int] | None) -> CameraIntrinsics:
    """The user's camera; without a grid, its image is centred on the principal point."""
    fx, fy, cx, cy = intrinsics
    width, height = size or (max(1, round(2 * cx + 1)), max(1, round(2 * cy + 1)))
    return CameraIntrinsics(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
