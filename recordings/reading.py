"""Opening a recording: the depth frames of one camera, whatever the recorder wrote them as."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from recordings.cameras.distortion import Undistortion, is_distorted
from recordings.cameras.matching import is_rectified, matching_camera
from recordings.cameras.pinhole import UnusableCamera, is_calibrated, stored_intrinsics
from recordings.depth_topics import DepthTopic, choose_depth_topic
from recordings.errors import RecordingError
from recordings.images.depth_pixels import MetricDepth, stored_pixels
from recordings.mcap_files.bag import Bag
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import CameraMessage, ImageMessage, UndecodableMessage
from recordings.options import ReadOptions
from recordings.stamps import in_order_of_stamps, selected
from recordings.types import CameraIntrinsics, Damage, Frame

_DEFAULT_OPTIONS = ReadOptions()


def open_recording(path: Path, options: ReadOptions = _DEFAULT_OPTIONS) -> McapRecording:
    """The depth frames of a recording: an MCAP file, a `.mcap.zstd` file or a rosbag2 folder.

    Raises:
        RecordingError: it cannot be read, has no depth, has several depth topics, or its camera is
            unknown and `options` do not give it.
    """
    decoded = DecodedBag(Bag(Path(path)))
    depth = choose_depth_topic(decoded, options.depth_topic)
    if depth is None:
        raise RecordingError(f"{path} has no depth images")
    return McapRecording(decoded, depth, options)


class McapRecording:
    """A `Recording` of one depth topic.

    Frames come in the order of their stamps (header.stamp; the log time where the recorder set none).
    Pixels are undistorted where the camera says that the topic's images are not rectified.
    """

    def __init__(self, decoded: DecodedBag, depth: DepthTopic, options: ReadOptions) -> None:
        self.depth_topic = depth.name
        self._decoded = decoded
        self._options = options
        self._size = depth.first.width, depth.first.height
        self._metric = MetricDepth(options.depth_scale_m, options.min_depth_m, options.max_depth_m)
        self._uses_log_time = depth.first.stamp_ns == 0
        self._intrinsics, self._undistortion = self._camera(depth)
        self._lost_frames = 0
        self._length: int | None = None

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The camera that took every frame."""
        return self._intrinsics

    @property
    def damage(self) -> Damage:
        """What was lost so far."""
        found = self._decoded.bag.damage
        return Damage(
            lost_messages=found.lost_messages + self._lost_frames,
            lost_chunks=found.lost_chunks,
            verified=found.verified,
        )

    def __len__(self) -> int:
        """Number of depth frames; counted by reading all of them once."""
        if self._length is None:
            self._length = sum(1 for _ in self)
        return self._length

    def __iter__(self) -> Iterator[Frame]:
        """Every frame once, in the order of stamps."""
        lost = count = 0

        def lose(_: object) -> None:
            nonlocal lost
            lost += 1
            self._lost_frames = max(self._lost_frames, lost)

        for stamp_ns, message in selected(
            in_order_of_stamps(self._images(lose), leave_out=lose), self._options
        ):
            try:
                depth_m = self._depth(message)
            except UndecodableMessage as error:
                lose(error)
                continue
            count += 1
            yield Frame(time_ns=stamp_ns, depth_m=depth_m)
        self._length = count

    def _images(self, lose) -> Iterator[tuple[int, ImageMessage]]:
        for log_time_ns, message in self._decoded.messages({self.depth_topic}):
            if isinstance(message, ImageMessage):
                yield log_time_ns if self._uses_log_time else message.stamp_ns, message
            else:
                lose(message)

    def _depth(self, message: ImageMessage):
        if (message.width, message.height) != self._size:
            raise UndecodableMessage(f"has another size ({message.width}x{message.height}) than the first")
        depth_m = self._metric(stored_pixels(message))
        return self._undistortion.depth(depth_m) if self._undistortion else depth_m

    def _camera(self, depth: DepthTopic) -> tuple[CameraIntrinsics, Undistortion | None]:
        width, height = self._size
        if self._options.intrinsics is not None:
            fx, fy, cx, cy = self._options.intrinsics
            return CameraIntrinsics(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy), None
        cameras = {
            topic: first
            for topic in self._decoded.topic_names
            if isinstance(first := self._decoded.first(topic), CameraMessage) and is_calibrated(first)
        }
        try:
            found = matching_camera(depth.name, depth.first.frame_id, self._size, cameras)
            if found is None:
                raise UnusableCamera("it has no camera topic; give --intrinsics fx,fy,cx,cy")
            rectified = is_rectified(depth.name)
            intrinsics = stored_intrinsics(found[1], width, height, rectified=rectified)
            if rectified or not is_distorted(found[1].distortion):
                return intrinsics, None
            return intrinsics, Undistortion(intrinsics, found[1].distortion_model, found[1].distortion)
        except UnusableCamera as error:
            raise RecordingError(f"{self._decoded.bag.path}, {depth.name}: {error}") from error
