"""Opening a recording: the depth frames of one camera, whatever the recorder wrote them as."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from recordings.cameras.matching import is_frame
from recordings.cameras.recorded import recorded_cameras
from recordings.colour_frames import ColourFrames, first_colour_topic
from recordings.colour_projection import ColourCamera, projected_colour
from recordings.colour_topics import ColourTopic, registered_colour, unread_images
from recordings.depth_clouds import DepthClouds
from recordings.depth_images import DepthImages
from recordings.depth_statistics import DepthStatistics
from recordings.depth_topics import DepthMessage, DepthTopic, choose_depth_topic
from recordings.depth_units import recorded_unit_m
from recordings.errors import RecordingError
from recordings.images.colour import ColourMessage, is_colour
from recordings.images.depth_pixels import MILLIMETRE_M
from recordings.images.mask import read_mask
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
from recordings.poses.transform_tree import recorded_transforms
from recordings.sensor_profile import SensorProfile, read_sensor_profile
from recordings.stamps import in_order_of_stamps, is_of_this_age, selected
from recordings.types import NO_RETURN, CameraIntrinsics, Damage, Frame

RUN_SCHEMA = "voxscene.Summary"
"""Of a topic that every run.mcap has and no recording: it holds views of a few frames and what was found."""

_DEFAULT_OPTIONS = ReadOptions()
_OUT_OF_ORDER = "its stamp is not after those before it: the clock stood still or was set back"
_SECOND_NS = 1_000_000_000
_STAMPS_LOOKED_AT = 8
"""Messages by whose stamps it is told whether a recorder sets any."""
_CLOCKS_OF_TODAY_NS = 365 * 24 * 3600 * _SECOND_NS
"""Clocks that show less, a year after 1970, count from the start of a simulation or a machine."""
_LEAST_SIDE_PX = 4
"""Surfaces are fitted to neighbours on all sides."""
_KEPT_FOR_COLOUR = 1 << 26
"""Colour is read beside the depth, by as many images before or behind as are put in the order of stamps."""

Lose = Callable[[str, object], None]
"""Is told of each message that cannot be used: its topic, and why."""
StampedMessage = TypeVar("StampedMessage", bound=DepthMessage)


def open_recording(path: Path, options: ReadOptions = _DEFAULT_OPTIONS) -> McapRecording:
    """The depth frames of a recording: an MCAP file, a `.mcap.zstd` or `.mcap.zst` file, or a rosbag2 folder.

    Raises:
        RecordingError: it cannot be read or is a run, has no depth (nor colour, where that is enough), has
            several depth topics, or its camera is unknown and `options` do not give it.
    """
    decoded = DecodedBag(Bag(Path(path)))
    if any(topic.schema_name == RUN_SCHEMA for topic in decoded.bag.topics):
        raise RecordingError(f"{path} is a run, not a recording; name what it was made from")
    topic = choose_depth_topic(decoded, options.depth_topic, options.start_s)
    if topic is None and options.colour_alone:
        topic = first_colour_topic(decoded)
        if topic is None:
            raise RecordingError(f"{path} has neither depth nor colour; {_what_else(decoded)}")
    if topic is None:
        raise RecordingError(f"{path} has no depth; {_what_else(decoded)}")
    recording = McapRecording(decoded, topic, options)
    _ = recording.intrinsics
    if min(recording.size) < _LEAST_SIDE_PX:
        width, height = recording.size
        raise RecordingError(f"{path}, {topic.name}: images of {width}x{height} pixels show no shape")
    return recording


class McapRecording:
    """The frames of one depth topic, or of one of colour alone.

    Frames come in the order of their stamps (header.stamp; the log time where the recorder set none). A stamp
    of zero is a time where a simulation's clock begins, else the frame is lost for want of one.
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
        self._first_stamp_ns = _first_stamp_ns(decoded, topic.name)
        self._uses_log_time = self._first_stamp_ns == 0
        self._colour: ColourTopic | ColourCamera | None = None
        cameras = recorded_cameras(decoded)
        try:
            if isinstance(topic.first, PointCloudMessage):
                self._depth = DepthClouds(topic, cameras, options)
            elif options.colour_alone and is_colour(topic.first):
                self._depth = ColourFrames(topic, cameras, options)
                self._colour = self._depth.colour
            else:
                unit_m = recorded_unit_m(decoded, topic.name) or MILLIMETRE_M
                self._depth = DepthImages(topic, cameras, options, unit_m)
                self._colour = self._colour_beside(self._depth, cameras)
                if self._colour:
                    decoded.bag.keep_blocks(_KEPT_FOR_COLOUR)
        except UndecodableMessage as error:
            raise RecordingError(f"{decoded.bag.path}, {topic.name}: {error}") from error
        self._losses: Counter[tuple[str, str]] = Counter()
        self._length: int | None = None
        self._left_out = None if options.mask is None else read_mask(options.mask, self.size)
        self.sensor: SensorProfile | None = None
        if options.sensor is not None:
            self.sensor = read_sensor_profile(Path(options.sensor), self.intrinsics)

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
        unused = [
            f"{n} message{'s' * (n != 1)} of {topic}: {reason}" for (topic, reason), n in self._losses.items()
        ]
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
    def colour_problem(self) -> str:
        """Why frames come without colour, so far as the recording shows."""
        unread = unread_images(self.decoded)
        return f"; {unread}" if unread and self._colour is None else ""

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

    @property
    def undecodable(self) -> int:
        """Messages of the depth topic that could not be used so far, for what they hold."""
        return sum(
            n
            for (topic, reason), n in self._losses.items()
            if topic == self.depth_topic and reason != _OUT_OF_ORDER
        )

    def __len__(self) -> int:
        """Number of depth frames; counted by reading all of them once."""
        if self._length is None:
            self._length = sum(1 for _ in self)
        return self._length

    def stamps_ns(self) -> Iterator[int]:
        """The stamps of the frames, without decoding their pixels."""
        messages = in_order_of_stamps(self._depth_messages(_ignore), leave_out=_ignore)
        chosen = selected(messages, self.options, lambda one: self._is_taken_here(one, _ignore))
        return (stamp_ns for stamp_ns, _ in chosen)

    def __iter__(self) -> Iterator[Frame]:
        """Every frame once, in the order of stamps."""
        return self._frames(None)

    def chosen(self, numbers: Collection[int]) -> Iterator[Frame]:
        """The frames of these numbers; the others are not decoded, and count even if they could not be."""
        return self._frames(numbers)

    def _frames(self, wanted: Collection[int] | None) -> Iterator[Frame]:
        losses: Counter[tuple[str, str]] = Counter()
        count = 0

        def lose(topic: str, reason: object) -> None:
            losses[topic, str(reason)] += 1
            if losses.total() > self._losses.total():
                self._losses = losses

        colours = NearestInTime(self._colour_messages(lose))
        self._follow_camera()
        messages = in_order_of_stamps(
            self._depth_messages(lose), leave_out=lambda _: lose(self.depth_topic, _OUT_OF_ORDER)
        )
        chosen = selected(messages, self.options, lambda one: self._is_taken_here(one, lose))
        for number, (stamp_ns, message) in enumerate(chosen):
            if wanted is not None and number not in wanted:
                continue
            try:
                depth_m = self._corrected(self._depth.depth(message, stamp_ns))
            except UndecodableMessage as error:
                lose(self.depth_topic, error)
                continue
            count += 1
            rgb, known = self._rgb(colours.at(stamp_ns), depth_m, stamp_ns, lose)
            yield Frame(time_ns=stamp_ns, depth_m=depth_m, rgb=rgb, rgb_known=known)
        self._length = count if wanted is None else self._length

    def statistics(self) -> DepthStatistics:
        """What depths and stamps look like: all messages are read, the first and four an octave decoded."""
        found = DepthStatistics()
        if isinstance(self._depth, DepthClouds):
            found.share_in_view = self._depth.share_in_view
            if self._depth.is_projected and recorded_transforms(self.decoded).is_fixed_frame(self.frame_id):
                found.fixed_frame = self.frame_id

        def stamped() -> Iterator[tuple[int, DepthMessage]]:
            for stamp_ns, message in self._depth_messages(_ignore):
                found.add_stamp(stamp_ns)
                yield stamp_ns, message

        starts_ns, first_ns = self._follow_camera(), None
        messages = in_order_of_stamps(stamped(), leave_out=_ignore)
        chosen = selected(messages, self.options, lambda one: self._is_taken_here(one, _ignore))
        for number, (stamp_ns, message) in enumerate(chosen):
            first_ns = stamp_ns if first_ns is None else first_ns
            found.add_message(message.data if isinstance(message, DepthMessage) else b"")
            if number % (1 << max(0, number.bit_length() - 3)) == 0:
                self._add_frame(found, message, stamp_ns)
        found.add_log_steps_back(self.decoded.bag.log_steps_back_s(self.depth_topic))
        found.camera_changes = [(start - (first_ns or 0)) / _SECOND_NS for start in starts_ns]
        return found

    def _add_frame(self, found: DepthStatistics, message: DecodedMessage, stamp_ns: int) -> None:
        if isinstance(self._depth, ColourFrames):
            found.add_frame(self._depth.depth(message, stamp_ns), None)
            return
        with suppress(UndecodableMessage):  # counted when the frames are read
            stored = self._depth.stored(message)
            depth_m = self._corrected(self._depth.metres(stored, stamp_ns))
            found.add_frame(depth_m, stored, self.options.depth_scale_m)

    def _follow_camera(self) -> tuple[int, ...]:
        """When the camera's calibration changes; each frame is used by its own from now on."""
        if not isinstance(self._depth, DepthImages):
            return ()
        return self._depth.follow_camera(self.decoded, uses_log_time=self._uses_log_time)

    def _sees_colour(self, stamp_ns: int) -> bool:
        """Whether colour is registered to the frame: it is to the first camera."""
        return not isinstance(self._depth, DepthImages) or self._depth.is_first_camera(stamp_ns)

    def _corrected(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """The same without what the user's mask and limits leave out, and without the sensor's distortion."""
        kept = depth_m if self._left_out is None else np.where(self._left_out, NO_RETURN, depth_m)
        if self.sensor is not None:
            kept = self.sensor.corrected(kept)
        near, far = self.options.min_depth_m, self.options.max_depth_m
        if near <= 0 and far == math.inf:
            return kept
        return np.where((kept < near) | (kept > far), NO_RETURN, kept)

    def _rgb(
        self,
        message: ColourMessage | None,
        depth_m: NDArray[np.float32],
        stamp_ns: int,
        lose: Lose,
    ) -> tuple[NDArray[np.uint8] | None, NDArray[np.bool_] | None]:
        """Colours of a depth image's pixels, and which of them are known where not all are."""
        if self._colour is None or message is None:
            return None, None
        try:
            if isinstance(self._colour, ColourCamera):
                return self._colour.rgb(message, depth_m)
            return (self._colour.rgb(message) if self._sees_colour(stamp_ns) else None), None
        except UndecodableMessage as error:
            lose(self._colour.name, error)
            return None, None

    def _depth_messages(self, lose: Lose) -> Iterator[tuple[int, DepthMessage]]:
        """Stamp and content of the depth messages, in the order of the file."""
        return self._stamped(
            self.depth_topic, (ImageMessage, CompressedImageMessage, PointCloudMessage), lose
        )

    def _colour_messages(self, lose: Lose) -> Iterator[tuple[int, ColourMessage]]:
        """Stamp and content of the colour messages, in the order of stamps."""
        if self._colour is None:
            return iter(())
        topic = self._colour.name
        if topic == self.depth_topic:  # colour alone: what is lost is told with the frames
            lose = _ignore
        messages = self._stamped(topic, (ImageMessage, CompressedImageMessage), lose)
        return in_order_of_stamps(messages, leave_out=lambda _: lose(topic, _OUT_OF_ORDER))

    def _stamped(
        self, topic: str, kinds: tuple[type[StampedMessage], ...], lose: Lose
    ) -> Iterator[tuple[int, StampedMessage]]:
        """Stamp and content of a topic's messages; of one that is written twice in a row the first."""
        before: tuple[int, bytes] | None = None
        for log_time_ns, message in self.decoded.messages({topic}):
            if not isinstance(message, kinds):
                lose(topic, message)
                continue
            stamp_ns = log_time_ns if self._uses_log_time else message.stamp_ns
            if not is_of_this_age(stamp_ns):
                lose(topic, "its stamp is no time of this age")
            elif stamp_ns == 0 and self._first_stamp_ns > _CLOCKS_OF_TODAY_NS:
                lose(topic, "has no stamp, where others have")
            elif (stamp_ns, message.data) != before:
                before = stamp_ns, message.data
                yield stamp_ns, message

    def _is_taken_here(self, message: DepthMessage, lose: Lose) -> bool:
        """Whether a depth message was taken where the first was; else it is lost."""
        if is_frame(message.frame_id, self.frame_id):
            return True
        lose(self.depth_topic, f"taken in the frame {message.frame_id!r}, the first in {self.frame_id!r}")
        return False


def _first_stamp_ns(decoded: DecodedBag, topic: str) -> int:
    """The first stamp of the topic's first messages that is not zero; zero where the recorder sets none."""
    first = islice((message for _, message in decoded.messages({topic})), _STAMPS_LOOKED_AT)
    return next((one.stamp_ns for one in first if isinstance(one, DepthMessage) and one.stamp_ns), 0)


def _what_else(decoded: DecodedBag) -> str:
    problems = [*decoded.bag.problems, *decoded.undecodable_topics()]
    if problems:
        return problems[0]
    topics = f"its topics: {', '.join(sorted({topic.name for topic in decoded.bag.topics})) or 'none'}"
    unread = unread_images(decoded)
    return f"{unread}; {topics}" if unread else topics


def _ignore(*_: object) -> None:
    """What cannot be used is counted when the frames are read."""
