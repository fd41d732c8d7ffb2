"""Which topic of a recording holds the depth: found by what its first message is, never by its name."""

from __future__ import annotations

from dataclasses import dataclass

from recordings.cameras.matching import base_topic, is_frame, namespace, shared_namespace
from recordings.errors import RecordingError
from recordings.first_colour import first_colour
from recordings.images.compressed_depth import holds_depth, image_size
from recordings.images.depth_pixels import DEPTH_DTYPES, stored_pixels
from recordings.images.point_clouds import points_of
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import (
    CompressedImageMessage,
    DecodedMessage,
    ImageMessage,
    PointCloudMessage,
    UndecodableMessage,
)

_SECOND_NS = 1_000_000_000

DepthMessage = ImageMessage | CompressedImageMessage | PointCloudMessage


@dataclass(frozen=True, kw_only=True)
class DepthTopic:
    """A topic of depth images or point clouds, and its first message that holds what it claims."""

    name: str
    first: DepthMessage


def depth_topics(decoded: DecodedBag) -> list[str]:
    """The topics whose first message could be depth, in the order of the alphabet.

    Images of 16-bit grey values (mono16) are taken for depth only where no other image is depth, since
    infrared cameras write them too; point clouds only where no image is depth.
    """
    kinds = _by_kind(decoded)
    return kinds["certain"] or kinds["grey"] or kinds["cloud"]


def choose_depth_topic(decoded: DecodedBag, wanted: str | None, start_s: float = 0.0) -> DepthTopic | None:
    """The depth topic of a recording, or None where it has none.

    Of several, the one that is neither another's copy in another transport nor resampled into the frame of a
    colour camera beside it, as `aligned_depth_to_color` is: that is what the sensor measured.

    Args:
        decoded: the recording.
        wanted: the topic that the user names, if any.
        start_s: seconds after its first message from which messages count, as far as there are any.

    Raises:
        RecordingError: several topics could be meant, the wanted one holds no depth, or none of its
            messages can be used.
    """
    path = decoded.bag.path
    if wanted is not None:
        topics = [topic for found in _by_kind(decoded).values() for topic in found]
        if wanted not in topics:
            known = ", ".join(topics) or "none"
            raise RecordingError(f"{path} has no depth topic {wanted}; its depth topics: {known}")
        return _with_first(decoded, wanted, start_s)
    candidates = depth_topics(decoded)
    own = _measured(decoded, candidates)
    if len(own) > 1:
        names = ", ".join(candidates)
        raise RecordingError(f"{path} has {len(candidates)} depth topics: {names}; choose with --depth-topic")
    return _with_first(decoded, own[0], start_s) if own else None


def is_aligned_to_colour(decoded: DecodedBag, topic: str) -> bool:
    """Whether a topic's depth images stand in the frame of a colour camera."""
    first = decoded.first(topic)
    frame_id = getattr(first, "frame_id", "")
    return bool(frame_id) and any(
        is_frame(other.frame_id, frame_id)
        for name in decoded.topic_names
        if name != topic and (other := first_colour(decoded, name)) is not None
    )


def _measured(decoded: DecodedBag, candidates: list[str]) -> list[str]:
    """The candidates without copies in another transport, and without those that others were resampled to."""
    plain = [
        topic
        for topic in candidates
        if not any(topic != other and base_topic(topic) == other for other in candidates)
    ]
    own = [topic for topic in plain if not is_aligned_to_colour(decoded, topic)]
    resampled = [t for t in plain if t not in own and any(_is_of_one_device(t, other) for other in own)]
    return [topic for topic in plain if topic not in resampled]


def _is_of_one_device(topic: str, other: str) -> bool:
    """Whether topics could be of one camera driver, which puts its streams side by side: /left/NAME/image."""
    devices = namespace(topic)[:-1], namespace(other)[:-1]
    return shared_namespace(topic, other) >= min(map(len, devices))


def _by_kind(decoded: DecodedBag) -> dict[str, list[str]]:
    kinds: dict[str, list[str]] = {"certain": [], "grey": [], "cloud": []}
    for topic in decoded.topic_names:
        kind = _kind(decoded.first(topic))
        if kind is not None:
            kinds[kind].append(topic)
    return kinds


def _kind(first: DecodedMessage | None) -> str | None:
    if isinstance(first, ImageMessage) and first.encoding in DEPTH_DTYPES:
        return "grey" if first.encoding == "mono16" else "certain"
    if isinstance(first, CompressedImageMessage) and holds_depth(first):
        return "grey" if first.format.startswith("mono16") else "certain"
    if isinstance(first, PointCloudMessage):
        return "cloud"
    return None


def _with_first(decoded: DecodedBag, topic: str, start_s: float) -> DepthTopic:
    """The topic with its first message that can be used, from a time on if there is one."""
    problem: UndecodableMessage | None = None
    earliest: DepthTopic | None = None
    start_ns: int | None = None
    for log_time_ns, message in decoded.messages({topic}):
        try:
            _check_size(message)
        except UndecodableMessage as error:
            problem = problem or error
            continue
        if isinstance(message, DepthMessage):
            stamp_ns = message.stamp_ns or log_time_ns
            start_ns = stamp_ns if start_ns is None else start_ns
            earliest = earliest or DepthTopic(name=topic, first=message)
            if stamp_ns - start_ns >= start_s * _SECOND_NS:
                return DepthTopic(name=topic, first=message)
    if earliest is not None:
        return earliest
    raise RecordingError(f"{decoded.bag.path}, {topic}: no message can be used; the first {problem}")


def _check_size(message: DecodedMessage | UndecodableMessage) -> None:
    """Raise UndecodableMessage unless the sizes that a depth message claims fit its data."""
    if isinstance(message, UndecodableMessage):
        raise message
    if isinstance(message, ImageMessage):
        stored_pixels(message)
    elif isinstance(message, CompressedImageMessage):
        image_size(message)
    elif isinstance(message, PointCloudMessage):
        points_of(message)
