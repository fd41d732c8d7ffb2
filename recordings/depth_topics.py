"""Which topic of a recording holds the depth: found by what its first message is, never by its name."""

from __future__ import annotations

from dataclasses import dataclass

from recordings.errors import RecordingError
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

DepthMessage = ImageMessage | CompressedImageMessage | PointCloudMessage


@dataclass(frozen=True, kw_only=True)
class DepthTopic:
    """A topic of depth images or point clouds, and its first message that holds what it claims."""

    name: str
    first: DepthMessage


def choose_depth_topic(decoded: DecodedBag, wanted: str | None) -> DepthTopic | None:
    """The depth topic of a recording, or None where it has none.

    Images of 16-bit grey values (mono16) are taken for depth only where no other image is depth, since
    infrared cameras write them too; point clouds only where no image is depth.

    Args:
        decoded: the recording.
        wanted: the topic that the user names, if any.

    Raises:
        RecordingError: several topics could be meant, the wanted one holds no depth, or none of its
            messages can be used.
    """
    kinds: dict[str, list[str]] = {"certain": [], "grey": [], "cloud": []}
    for topic in decoded.topic_names:
        kind = _kind(decoded.first(topic))
        if kind is not None:
            kinds[kind].append(topic)
    path = decoded.bag.path
    if wanted is not None:
        topics = [topic for found in kinds.values() for topic in found]
        if wanted not in topics:
            known = ", ".join(topics) or "none"
            raise RecordingError(f"{path} has no depth topic {wanted}; its depth topics: {known}")
        return _with_first(decoded, wanted)
    candidates = kinds["certain"] or kinds["grey"] or kinds["cloud"]
    if len(candidates) > 1:
        names = ", ".join(candidates)
        raise RecordingError(f"{path} has {len(candidates)} depth topics: {names}; choose with --depth-topic")
    return _with_first(decoded, candidates[0]) if candidates else None


def _kind(first: DecodedMessage | None) -> str | None:
    if isinstance(first, ImageMessage) and first.encoding in DEPTH_DTYPES:
        return "grey" if first.encoding == "mono16" else "certain"
    if isinstance(first, CompressedImageMessage) and holds_depth(first):
        return "certain"
    if isinstance(first, PointCloudMessage):
        return "cloud"
    return None


def _with_first(decoded: DecodedBag, topic: str) -> DepthTopic:
    problem: UndecodableMessage | None = None
    for _, message in decoded.messages({topic}):
        try:
            _check_size(message)
        except UndecodableMessage as error:
            problem = problem or error
            continue
        if isinstance(message, DepthMessage):
            return DepthTopic(name=topic, first=message)
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
