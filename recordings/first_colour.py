"""The first image of a colour topic that can be used: the very first is often cut off or empty."""

from __future__ import annotations

from itertools import islice

from recordings.images.colour import ColourMessage, colour_size, is_colour
from recordings.images.compressed_depth import holds_depth
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import CompressedImageMessage, ImageMessage, UndecodableMessage

_LOOKED_AT = 8
"""Images of a compressed topic: where none of them is colour, it holds none."""


def first_colour(decoded: DecodedBag, topic: str) -> ColourMessage | None:
    """The first image of a topic that says its size, or None where the topic holds no colour."""
    first = decoded.first(topic)
    if isinstance(first, CompressedImageMessage) and not holds_depth(first):
        images = islice((message for _, message in decoded.messages({topic})), _LOOKED_AT)
        return next(
            (one for one in images if isinstance(one, CompressedImageMessage) and _is_usable(one)), None
        )
    return first if isinstance(first, ImageMessage) and is_colour(first) else None


def _is_usable(image: CompressedImageMessage) -> bool:
    try:
        return is_colour(image) and min(colour_size(image)) > 0
    except UndecodableMessage:
        return False
