"""Colour images: raw 8-bit pixels in the usual orders, JPEG and PNG."""

from __future__ import annotations

import io
import warnings

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recordings.images.depth_pixels import MAX_PIXELS, pixel_rows
from recordings.messages.types import CompressedImageMessage, ImageMessage, UndecodableMessage

_CHANNELS = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "8UC3": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "8UC4": (4, (2, 1, 0)),
}
"""Bytes a pixel and where red, green and blue stand. OpenCV's own names mean its order, BGR."""

ColourMessage = ImageMessage | CompressedImageMessage


def is_colour(message: object) -> bool:
    """Whether an image message holds colour; what a compressed one holds shows when it is decoded."""
    if isinstance(message, ImageMessage):
        return message.encoding in _CHANNELS
    return isinstance(message, CompressedImageMessage) and _compressed_format(message.data) is not None


def colour_size(message: ColourMessage) -> tuple[int, int]:
    """Width and height of a colour image.

    Raises:
        UndecodableMessage: a compressed image is damaged in its first bytes.
    """
    if isinstance(message, ImageMessage):
        return message.width, message.height
    with _opened(message.data) as image:
        return image.size


def decode_colour(message: ColourMessage) -> NDArray[np.uint8]:
    """The (H, W, 3) RGB pixels of a colour image.

    Raises:
        UndecodableMessage: the image is damaged, too large or no colour image.
    """
    if isinstance(message, ImageMessage):
        if message.encoding not in _CHANNELS:
            raise UndecodableMessage(f"has the encoding {message.encoding!r}, which is no known colour")
        channels, order = _CHANNELS[message.encoding]
        rows = pixel_rows(message, channels)
        return np.ascontiguousarray(rows.reshape(message.height, message.width, channels)[..., order])
    with _opened(message.data) as image:
        try:
            return np.asarray(image.convert("RGB"))
        except Exception as error:  # Pillow raises half a dozen kinds on damaged images
            raise UndecodableMessage(f"is a damaged colour image ({error})") from error


def resampled(rgb: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """The nearest pixel (height, width, 3) of the same view at another size; pixel centres are integers."""
    if rgb.shape[:2] == (height, width):
        return rgb
    rows = ((np.arange(height) + 0.5) * rgb.shape[0] / height).astype(np.intp)
    columns = ((np.arange(width) + 0.5) * rgb.shape[1] / width).astype(np.intp)
    return np.ascontiguousarray(rgb[rows[:, None], columns])


def _compressed_format(data: bytes) -> str | None:
    if data.startswith(b"\xff\xd8\xff"):
        return "JPEG"
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return "PNG"
    return None


def _opened(data: bytes) -> Image.Image:
    """The image with its size checked, its pixels not yet decoded."""
    format_ = _compressed_format(data)
    if format_ is None:
        raise UndecodableMessage("is neither JPEG nor PNG")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(data), formats=[format_])
    except Exception as error:  # Pillow raises half a dozen kinds on damaged images
        raise UndecodableMessage(f"is a damaged {format_} image ({error})") from error
    if image.width * image.height > MAX_PIXELS:
        raise UndecodableMessage(f"claims to be an image of {image.width}x{image.height} pixels")
    return image
