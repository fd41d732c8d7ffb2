"""Which topic of a recording holds the depth: found by what its first image is, never by its name."""

from __future__ import annotations

from dataclasses import dataclass

from recordings.errors import RecordingError
from recordings.images.depth_pixels import DEPTH_DTYPES
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import ImageMessage

DepthMessage = ImageMessage


@dataclass(frozen=True, kw_only=True)
class DepthTopic:
    """A topic of depth images and its first readable message."""

    name: str
    first: DepthMessage


def choose_depth_topic(decoded: DecodedBag, wanted: str | None) -> DepthTopic | None:
    """The depth topic of a recording, or None where it has none.

    16-bit grey images (mono16) are taken for depth only where nothing else is, since infrared cameras
    write them too.

    Args:
        decoded: the recording.
        wanted: the topic that the user names, if any.

    Raises:
        RecordingError: several topics could be meant, or the wanted one holds no depth.
    """
    images = _first_images(decoded)
    depth = {t: first for t, first in images.items() if first.encoding in DEPTH_DTYPES}
    certain = {t: first for t, first in depth.items() if first.encoding != "mono16"}
    path = decoded.bag.path
    if wanted is not None:
        if wanted not in depth:
            known = ", ".join(depth) or "none"
            raise RecordingError(f"{path} has no depth topic {wanted}; its depth topics: {known}")
        return DepthTopic(name=wanted, first=depth[wanted])
    candidates = certain or depth
    if len(candidates) > 1:
        names = ", ".join(candidates)
        raise RecordingError(f"{path} has {len(candidates)} depth topics: {names}; choose with --depth-topic")
    return next((DepthTopic(name=name, first=first) for name, first in candidates.items()), None)


def _first_images(decoded: DecodedBag) -> dict[str, ImageMessage]:
    firsts = ((topic, decoded.first(topic)) for topic in decoded.topic_names)
    return {topic: first for topic, first in firsts if isinstance(first, ImageMessage)}
