"""Which topic of a recording holds the depth: found by what its first message is, never by its name."""

from __future__ import annotations

from dataclasses import dataclass

from recordings.errors import RecordingError
from recordings.images.compressed_depth import holds_depth
from recordings.images.depth_pixels import DEPTH_DTYPES
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import (
    CompressedImageMessage,
    DecodedMessage,
    ImageMessage,
    PointCloudMessage,
)

DepthMessage = ImageMessage | CompressedImageMessage | PointCloudMessage


@dataclass(frozen=True, kw_only=True)
class DepthTopic:
    """A topic of depth images or point clouds, and its first readable message."""

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
        RecordingError: several topics could be meant, or the wanted one holds no depth.
    """
    kinds: dict[str, list[DepthTopic]] = {"certain": [], "grey": [], "cloud": []}
    for topic in decoded.topic_names:
        first = decoded.first(topic)
        kind = _kind(first)
        if kind is not None and isinstance(first, DepthMessage):
            kinds[kind].append(DepthTopic(name=topic, first=first))
    path = decoded.bag.path
    if wanted is not None:
        topics = {topic.name: topic for found in kinds.values() for topic in found}
        if wanted not in topics:
            known = ", ".join(topics) or "none"
            raise RecordingError(f"{path} has no depth topic {wanted}; its depth topics: {known}")
        return topics[wanted]
    candidates = kinds["certain"] or kinds["grey"] or kinds["cloud"]
    if len(candidates) > 1:
        names = ", ".join(topic.name for topic in candidates)
        raise RecordingError(f"{path} has {len(candidates)} depth topics: {names}; choose with --depth-topic")
    return candidates[0] if candidates else None


def _kind(first: DecodedMessage | None) -> str | None:
    if isinstance(first, ImageMessage) and first.encoding in DEPTH_DTYPES:
        return "grey" if first.encoding == "mono16" else "certain"
    if isinstance(first, CompressedImageMessage) and holds_depth(first):
        return "certain"
    if isinstance(first, PointCloudMessage):
        return "cloud"
    return None
