"""Frames of a colour topic alone, for recordings without depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.cameras.distortion import Undistortion, is_distorted
from recordings.cameras.matching import is_rectified, matching_camera
from recordings.cameras.pinhole import NO_CALIBRATION, UnusableCamera, stored_intrinsics
from recordings.colour_topics import ColourTopic
from recordings.depth_topics import DepthTopic
from recordings.first_colour import first_colour
from recordings.images.colour import colour_size
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import CameraMessage, CompressedImageMessage, DecodedMessage, ImageMessage
from recordings.options import ReadOptions
from recordings.types import NO_RETURN, CameraIntrinsics


def first_colour_topic(decoded: DecodedBag) -> DepthTopic | None:
    """The first topic, by the alphabet, of images in colour; None without any."""
    for topic in decoded.topic_names:
        first = first_colour(decoded, topic)
        if first is not None:
            return DepthTopic(name=topic, first=first)
    return None


class ColourFrames:
    """Depth images without any return, one for each colour image, of the pinhole camera that took them.

    Args:
        topic: of colour images.
        cameras: a usable message of each camera topic.
        options: what the user says.

    Raises:
        UndecodableMessage: the first image is damaged.
    """

    def __init__(self, topic: DepthTopic, cameras: dict[str, CameraMessage], options: ReadOptions) -> None:
        assert isinstance(topic.first, ImageMessage | CompressedImageMessage)
        self.size = colour_size(topic.first)
        self.intrinsics: CameraIntrinsics | None = None
        self.camera_topic: str | None = None
        self.camera_problem: str | None = None
        self.frame_from_camera = np.eye(4)
        self._topic, self._undistortion = topic, None
        if options.intrinsics is not None:
            fx, fy, cx, cy = options.intrinsics
            self.intrinsics = CameraIntrinsics(
                width=self.size[0], height=self.size[1], fx=fx, fy=fy, cx=cx, cy=cy
            )
            return
        try:
            self._take_recorded_camera(cameras)
        except UnusableCamera as error:
            self.camera_problem = str(error)

    def _take_recorded_camera(self, cameras: dict[str, CameraMessage]) -> None:
        found = matching_camera(self._topic.name, self._topic.first.frame_id, self.size, cameras)
        if found is None:
            raise UnusableCamera(NO_CALIBRATION)
        rectified = is_rectified(self._topic.name)
        self.intrinsics = stored_intrinsics(found[1], *self.size, rectified=rectified)
        if not rectified and is_distorted(found[1].distortion):
            self._undistortion = Undistortion(self.intrinsics, found[1].distortion_model, found[1].distortion)
        self.camera_topic = found[0]

    @property
    def colour(self) -> ColourTopic | None:
        """How the images become colours of the camera's pixels; None where the camera is unknown."""
        if self.intrinsics is None:
            return None
        return ColourTopic(
            name=self._topic.name,
            size=self.size,
            camera=self.intrinsics,
            undistortion=self._undistortion,
        )

    def depth(self, message: DecodedMessage, time_ns: int) -> NDArray[np.float32]:
        """Nothing was measured, (H, W)."""
        del message, time_ns
        return np.full(self.size[::-1], NO_RETURN, np.float32)
