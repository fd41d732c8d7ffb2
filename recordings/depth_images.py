"""Depth from image topics: stored pixels, their camera, and the undistorted metres that they mean."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.cameras.distortion import Undistortion, is_distorted
from recordings.cameras.matching import is_rectified, matching_camera
from recordings.cameras.pinhole import UnusableCamera, stored_intrinsics
from recordings.depth_topics import DepthTopic
from recordings.images.compressed_depth import image_size, stored_depth
from recordings.images.depth_pixels import MetricDepth, stored_pixels
from recordings.messages.types import (
    CameraMessage,
    CompressedImageMessage,
    DecodedMessage,
    ImageMessage,
    UndecodableMessage,
)
from recordings.options import ReadOptions
from recordings.types import CameraIntrinsics


class DepthImages:
    """Turns the messages of a depth image topic into depth images of one pinhole camera.

    Where the camera cannot be known, `intrinsics` is None, `camera_problem` says why, and depths are
    those of the pixels as they are stored.

    Args:
        topic: the topic.
        cameras: a usable message of each camera topic.
        options: what the user says.
    """

    def __init__(self, topic: DepthTopic, cameras: dict[str, CameraMessage], options: ReadOptions) -> None:
        self._metric = MetricDepth(options.depth_scale_m, options.min_depth_m, options.max_depth_m)
        self.size = _size(topic.first)
        self.intrinsics: CameraIntrinsics | None = None
        self.camera_topic: str | None = None
        self.camera_problem: str | None = None
        self.undistortion: Undistortion | None = None
        self.frame_from_camera = np.eye(4)
        if options.intrinsics is not None:
            self.intrinsics = _given(options.intrinsics, self.size)
            return
        try:
            self._take_recorded_camera(topic, cameras)
        except UnusableCamera as error:
            self.camera_problem = str(error)

    def _take_recorded_camera(self, topic: DepthTopic, cameras: dict[str, CameraMessage]) -> None:
        found = matching_camera(topic.name, topic.first.frame_id, self.size, cameras)
        if found is None:
            raise UnusableCamera("its camera is not recorded; give --intrinsics fx,fy,cx,cy")
        camera_topic, camera = found
        rectified = is_rectified(topic.name)
        intrinsics = stored_intrinsics(camera, *self.size, rectified=rectified)
        if not rectified and is_distorted(camera.distortion):
            self.undistortion = Undistortion(intrinsics, camera.distortion_model, camera.distortion)
        self.camera_topic, self.intrinsics = camera_topic, intrinsics

    def depth(self, message: DecodedMessage) -> NDArray[np.float32]:
        """The undistorted depth image (H, W) in metres.

        Raises:
            UndecodableMessage: the message is damaged, or of another size than the first.
        """
        if not isinstance(message, ImageMessage | CompressedImageMessage):
            raise UndecodableMessage("is no image")
        if _size(message) != self.size:
            (width, height), (first_width, first_height) = _size(message), self.size
            raise UndecodableMessage(f"is {width}x{height} where the first is {first_width}x{first_height}")
        stored = stored_pixels(message) if isinstance(message, ImageMessage) else stored_depth(message)
        depth_m = self._metric(stored)
        return self.undistortion.depth(depth_m) if self.undistortion else depth_m


def _size(message: DecodedMessage) -> tuple[int, int]:
    if isinstance(message, ImageMessage):
        return message.width, message.height
    assert isinstance(message, CompressedImageMessage)
    return image_size(message)


def _given(intrinsics: tuple[float, float, float, float], size: tuple[int, int]) -> CameraIntrinsics:
    fx, fy, cx, cy = intrinsics
    return CameraIntrinsics(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy)
