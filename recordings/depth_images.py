"""Depth from image topics: stored pixels, their camera, and the undistorted metres that they mean."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.cameras.distortion import Undistortion, is_distorted
from recordings.cameras.matching import is_rectified, matching_camera
from recordings.cameras.pinhole import NO_CALIBRATION, UnusableCamera, stored_intrinsics
from recordings.cameras.recorded import CameraTrack, camera_track
from recordings.depth_topics import DepthTopic
from recordings.images.compressed_depth import image_size, stored_depth
from recordings.images.depth_pixels import MILLIMETRE_M, MetricDepth, stored_pixels
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import (
    CameraMessage,
    CompressedImageMessage,
    DecodedMessage,
    ImageMessage,
    UndecodableMessage,
)
from recordings.options import ReadOptions
from recordings.types import CameraIntrinsics

_KEPT_CAMERAS = 8
"""Calibrations whose lookup is kept: a zoom may have one for each frame."""


class DepthImages:
    """Turns the messages of a depth image topic into depth images of one pinhole camera.

    Where the camera cannot be known, `intrinsics` is None, `camera_problem` says why, and depths are
    those of the pixels as they are stored.

    Args:
        topic: the topic.
        cameras: a usable message of each camera topic.
        options: what the user says.
        unit_m: metres for a stored 1 of integers, where the user does not say it.
    """

    def __init__(
        self,
        topic: DepthTopic,
        cameras: dict[str, CameraMessage],
        options: ReadOptions,
        unit_m: float = MILLIMETRE_M,
    ) -> None:
        self._metric = MetricDepth(options.depth_scale_m, unit_m)
        self.size = _size(topic.first)
        self.intrinsics: CameraIntrinsics | None = None
        self.camera_topic: str | None = None
        self.camera_problem: str | None = None
        self.undistortion: Undistortion | None = None
        self.frame_from_camera = np.eye(4)
        self._rectified = is_rectified(topic.name)
        self._track: CameraTrack | None = None
        self._undistortions: dict[int, Undistortion | None] = {}
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
            raise UnusableCamera(NO_CALIBRATION)
        camera_topic, self._camera = found
        intrinsics = stored_intrinsics(self._camera, *self.size, rectified=self._rectified)
        self.undistortion = self._undistortion(self._camera, intrinsics, intrinsics)
        self.camera_topic, self.intrinsics = camera_topic, intrinsics

    def follow_camera(self, decoded: DecodedBag, *, uses_log_time: bool) -> tuple[int, ...]:
        """Read every calibration of the camera, by which each frame is used from now on; when it changes."""
        if self.camera_topic is None:
            return ()
        if self._track is None:
            self._track = camera_track(decoded, self.camera_topic, self._camera, uses_log_time=uses_log_time)
        return self._track.starts_ns

    def is_first_camera(self, time_ns: int) -> bool:
        """Whether the calibration of the first frame holds at a time."""
        return self._track is None or self._track.at(time_ns) is self._track.cameras[0]

    def stored(self, message: DecodedMessage) -> NDArray:
        """The numbers (H, W) of a depth image as they are stored.

        Raises:
            UndecodableMessage: the message is damaged, or of another size than the first.
        """
        if not isinstance(message, ImageMessage | CompressedImageMessage):
            raise UndecodableMessage("is no image")
        if _size(message) != self.size:
            (width, height), (first_width, first_height) = _size(message), self.size
            raise UndecodableMessage(f"is {width}x{height} where the first is {first_width}x{first_height}")
        return stored_pixels(message) if isinstance(message, ImageMessage) else stored_depth(message)

    def metres(self, stored: NDArray, time_ns: int) -> NDArray[np.float32]:
        """The undistorted depth image (H, W) of stored numbers, as the first frame's camera sees it.

        Raises:
            UndecodableMessage: nothing can be known of the camera at that time.
        """
        depth_m = self._metric(stored)
        undistortion = self._undistortion_at(time_ns)
        return undistortion.depth(depth_m) if undistortion else depth_m

    def depth(self, message: DecodedMessage, time_ns: int) -> NDArray[np.float32]:
        """The undistorted depth image (H, W) in metres.

        Raises:
            UndecodableMessage: the message is damaged, of another size than the first, or of a camera of
                which nothing can be known.
        """
        return self.metres(self.stored(message), time_ns)

    def _undistortion_at(self, time_ns: int) -> Undistortion | None:
        if self.is_first_camera(time_ns) or self.intrinsics is None or self._track is None:
            return self.undistortion
        camera = self._track.at(time_ns)
        if id(camera) not in self._undistortions:
            try:
                stored = stored_intrinsics(camera, *self.size, rectified=self._rectified)
                found = self._undistortion(camera, self.intrinsics, stored)
            except UnusableCamera as error:
                raise UndecodableMessage(f"cannot be used: {error}") from error
            if len(self._undistortions) >= _KEPT_CAMERAS:
                self._undistortions.pop(next(iter(self._undistortions)))
            self._undistortions[id(camera)] = found
        return self._undistortions[id(camera)]

    def _undistortion(
        self, camera: CameraMessage, intrinsics: CameraIntrinsics, stored: CameraIntrinsics
    ) -> Undistortion | None:
        """How an image of `camera` becomes one of the pinhole camera `intrinsics`; None where it is one."""
        distorted = not self._rectified and is_distorted(camera.distortion)
        if not distorted and stored == intrinsics:
            return None
        coefficients = camera.distortion if distorted else ()
        return Undistortion(intrinsics, camera.distortion_model, coefficients, stored)


def _size(message: DecodedMessage) -> tuple[int, int]:
    if isinstance(message, ImageMessage):
        return message.width, message.height
    assert isinstance(message, CompressedImageMessage)
    return image_size(message)


def _given(intrinsics: tuple[float, float, float, float], size: tuple[int, int]) -> CameraIntrinsics:
    fx, fy, cx, cy = intrinsics
    return CameraIntrinsics(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy)
