"""The first image of a colour topic that can be used: the very first is often cut off or empty."""

from __future__ import annotations

from itertools import islice

from recordings.images.colour import ColourMessage, colour_size, is_colour, is_grey
from recordings.images.compressed_depth import holds_depth
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import CompressedImageMessage, DecodedMessage, UndecodableMessage

_LOOKED_AT = 8
"""Images of a topic: where none of them is colour, it holds none."""


def first_colour(decoded: DecodedBag, topic: str) -> ColourMessage | None:
    """The first image of a topic that says its size, or None where the topic holds no colour."""
    if not _may_hold_colour(decoded.first(topic)):
        return None
    messages = (message for _, message in decoded.messages({topic}))
    images = (message for message in messages if isinstance(message, ColourMessage))
    return next((one for one in islice(images, _LOOKED_AT) if _is_usable(one)), None)


def _may_hold_colour(first: DecodedMessage | None) -> bool:
    """Whether a topic may, by its first message; a compressed one that is cut off does not tell."""
    if isinstance(first, CompressedImageMessage):
        return not holds_depth(first)
    return is_colour(first)


def _is_usable(image: ColourMessage) -> bool:
    try:
        return is_colour(image) and not is_grey(image) and min(colour_size(image)) > 0
    except UndecodableMessage:
        return False
