"""Opening a recording: the depth frames of one camera, whatever the recorder wrote them as."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recordings.cameras.recorded import recorded_cameras
from recordings.colour_projection import ColourCamera, projected_colour
from recordings.colour_topics import ColourTopic, registered_colour
from recordings.depth_clouds import DepthClouds
from recordings.depth_images import DepthImages
from recordings.depth_topics import DepthTopic, choose_depth_topic
from recordings.errors import RecordingError
from recordings.images.colour import ColourMessage
from recordings.images.pairing import NearestInTime
from recordings.mcap_files.bag import Bag
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import (
    CameraMessage,
    CompressedImageMessage,
    DecodedMessage,
    ImageMessage,
    PointCloudMessage,
    UndecodableMessage,
)
from recordings.options import ReadOptions
from recordings.stamps import in_order_of_stamps, selected
from recordings.types import CameraIntrinsics, Damage, Frame

_DEFAULT_OPTIONS = ReadOptions()
_KEPT_FOR_COLOUR = 1 << 26
"""Colour is read behind the depth, by as many frames as are put in the order of stamps."""


def open_recording(path: Path, options: ReadOptions = _DEFAULT_OPTIONS) -> McapRecording:
    """The depth frames of a recording: an MCAP file, a `.mcap.zstd` file or a rosbag2 folder.

    Raises:
        RecordingError: it cannot be read, has no depth, has several depth topics, or its camera is
            unknown and `options` do not give it.
    """
    decoded = DecodedBag(Bag(Path(path)))
    topic = choose_depth_topic(decoded, options.depth_topic)
    if topic is None:
        raise RecordingError(f"{path} has no depth; {_what_else(decoded)}")
    recording = McapRecording(decoded, topic, options)
    _ = recording.intrinsics
    return recording


class McapRecording:
    """A `Recording` of one depth topic.

    Frames come in the order of their stamps (header.stamp; the log time where the recorder set none).
    Colour comes with them where a topic of the recording is registered to the depth, or else where both
    cameras' calibrations and the transform between them are recorded.

    Raises:
        RecordingError: a point cloud shows nothing that a camera could look at.
    """

    def __init__(self, decoded: DecodedBag, topic: DepthTopic, options: ReadOptions) -> None:
        self.depth_topic = topic.name
        self.frame_id = topic.first.frame_id
        self.decoded = decoded
        self.options = options
        self._uses_log_time = topic.first.stamp_ns == 0
        self._colour: ColourTopic | ColourCamera | None = None
        cameras = recorded_cameras(decoded)
        try:
            if isinstance(topic.first, PointCloudMessage):
                self._depth = DepthClouds(topic, cameras, options)
            else:
                self._depth = DepthImages(topic, cameras, options)
                self._colour = self._colour_beside(self._depth, cameras)
                if self._colour:
                    decoded.bag.keep_blocks(_KEPT_FOR_COLOUR)
        except UndecodableMessage as error:
            raise RecordingError(f"{decoded.bag.path}, {topic.name}: {error}") from error
        self._losses: Counter[str] = Counter()
        self._length: int | None = None

    def _colour_beside(
        self, depth: DepthImages, cameras: dict[str, CameraMessage]
    ) -> ColourTopic | ColourCamera | None:
        """The colour that is registered to the depth images, else what can be projected onto them."""
        registered = registered_colour(self.decoded, depth, self.frame_id, cameras)
        if registered or depth.intrinsics is None or not self.frame_id:
            return registered
        return projected_colour(self.decoded, self.depth_topic, self.frame_id, depth.intrinsics, cameras)

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """The camera that took every frame.

        Raises:
            RecordingError: it cannot be known.
        """
        if self._depth.intrinsics is None:
            raise RecordingError(f"{self.decoded.bag.path}, {self.depth_topic}: {self.camera_problem}")
        return self._depth.intrinsics

    @property
    def camera_problem(self) -> str | None:
        """Why the camera cannot be known, if so."""
        return self._depth.camera_problem

    @property
    def problems(self) -> list[str]:
        """A sentence for a person on each loss so far."""
        unused = [f"{n} messages of {self.depth_topic}: {reason}" for reason, n in self._losses.items()]
        return self.decoded.bag.problems + unused

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of every frame."""
        return self._depth.size

    @property
    def camera_topic(self) -> str | None:
        """The topic that the intrinsics were read from, if any."""
        return self._depth.camera_topic

    @property
    def colour_topic(self) -> str | None:
        """The topic of colour images that come with the frames, if any."""
        return self._colour.name if self._colour else None

    @property
    def colour_is_projected(self) -> bool:
        """Whether that colour was taken by another camera and is looked up point by point."""
        return isinstance(self._colour, ColourCamera)

    @property
    def frame_from_camera(self) -> NDArray[np.float64]:
        """The camera (4, 4) in the frame `frame_id`; not the identity where a cloud looks along x."""
        return self._depth.frame_from_camera

    @property
    def damage(self) -> Damage:
        """What was lost so far."""
        found = self.decoded.bag.damage
        return Damage(
            lost_messages=found.lost_messages + self._losses.total(),
            lost_chunks=found.lost_chunks,
            verified=found.verified,
        )

    def __len__(self) -> int:
        """Number of depth frames; counted by reading all of them once."""
        if self._length is None:
            self._length = sum(1 for _ in self)
        return self._length

    def stamps_ns(self) -> Iterator[int]:
        """The stamps of the frames, without decoding their pixels."""
        messages = in_order_of_stamps(self._depth_messages(_ignore), leave_out=_ignore)
        return (stamp_ns for stamp_ns, _ in selected(messages, self.options))

    def __iter__(self) -> Iterator[Frame]:
        """Every frame once, in the order of stamps."""
        losses: Counter[str] = Counter()
        count = 0

        def lose(reason: object) -> None:
            losses[str(reason)] += 1
            if losses.total() > self._losses.total():
                self._losses = losses

        colours = NearestInTime(self._colour_messages(lose))
        messages = in_order_of_stamps(
            self._depth_messages(lose), leave_out=lambda _: lose("too late, or a stamp twice")
        )
        for stamp_ns, message in selected(messages, self.options):
            try:
                depth_m = self._depth.depth(message)
            except UndecodableMessage as error:
                lose(error)
                continue
            count += 1
            rgb, known = self._rgb(colours.at(stamp_ns), depth_m, lose)
            yield Frame(time_ns=stamp_ns, depth_m=depth_m, rgb=rgb, rgb_known=known)
        self._length = count

    def _rgb(
        self, message: ColourMessage | None, depth_m: NDArray[np.float32], lose: Callable[[object], None]
    ) -> tuple[NDArray[np.uint8] | None, NDArray[np.bool_] | None]:
        """Colours of a depth image's pixels, and which of them are known where not all are."""
        if self._colour is None or message is None:
            return None, None
        try:
            if isinstance(self._colour, ColourCamera):
                return self._colour.rgb(message, depth_m)
            return self._colour.rgb(message), None
        except UndecodableMessage as error:
            lose(error)
            return None, None

    def _depth_messages(self, lose: Callable[[object], None]) -> Iterator[tuple[int, DecodedMessage]]:
        for log_time_ns, message in self.decoded.messages({self.depth_topic}):
            if isinstance(message, ImageMessage | CompressedImageMessage | PointCloudMessage):
                yield log_time_ns if self._uses_log_time else message.stamp_ns, message
            else:
                lose(message)

    def _colour_messages(self, lose: Callable[[object], None]) -> Iterator[tuple[int, ColourMessage]]:
        if self._colour is None:
            return
        for log_time_ns, message in self.decoded.messages({self._colour.name}):
            if isinstance(message, ImageMessage | CompressedImageMessage):
                yield log_time_ns if self._uses_log_time else message.stamp_ns, message
            else:
                lose(message)


def _what_else(decoded: DecodedBag) -> str:
    problems = decoded.bag.problems
    if problems:
        return f"{problems[0]}"
    return f"its topics: {', '.join(sorted({topic.name for topic in decoded.bag.topics})) or 'none'}"


def _ignore(_: object) -> None:
    """What cannot be used is counted when the frames are read."""
