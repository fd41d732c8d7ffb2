"""Colour images: raw pixels of 8 or 16 bits in the usual orders, YUV 4:2:2, JPEG and PNG."""

from __future__ import annotations

import io
import warnings

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recordings.images.compressed_depth import holds_depth
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
_WIDE_CHANNELS = {"rgb16": (0, 1, 2), "bgr16": (2, 1, 0), "16UC3": (2, 1, 0)}
"""The same of three 16-bit numbers, of which the upper 8 bits are taken."""
_CHROMA_FIRST = {"yuv422": 1, "UYVY": 1, "uyvy": 1, "yuv422_yuy2": 0, "YUY2": 0, "YUYV": 0, "yuyv": 0}
"""Two bytes a pixel, Y and one of U and V for two pixels: where Y stands (sensor_msgs/image_encodings)."""
_RGB_FROM_YUV = np.array([[1.164, 0, 1.596], [1.164, -0.392, -0.813], [1.164, 2.017, 0]], np.float32)
"""Of Y - 16, U - 128, V - 128 in the range of television (ITU-R BT.601), as cv_bridge takes it."""
_GREY_MODES = {"1", "L", "LA", "I", "I;16"}
"""Pillow's names of one brightness a pixel: infrared and the like, as mono8 is among raw images."""

ColourMessage = ImageMessage | CompressedImageMessage


def is_colour(message: object) -> bool:
    """Whether an image message holds colour; what a compressed one holds shows when it is decoded."""
    if isinstance(message, ImageMessage):
        return message.encoding in {*_CHANNELS, *_WIDE_CHANNELS, *_CHROMA_FIRST}
    if not isinstance(message, CompressedImageMessage) or holds_depth(message):
        return False
    return _compressed_format(message.data) is not None


def is_grey(message: ColourMessage) -> bool:
    """Whether an image for which `is_colour` holds is grey after all, as a compressed one says in its head.

    Raises:
        UndecodableMessage: a compressed image is damaged in its first bytes.
    """
    if isinstance(message, ImageMessage):
        return False
    with _opened(message.data) as image:
        return image.mode in _GREY_MODES


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
        return np.ascontiguousarray(_raw_rgb(message))
    with _opened(message.data) as image:
        try:
            return np.asarray(image.convert("RGB"))
        except Exception as error:  # Pillow raises half a dozen kinds on damaged images
            raise UndecodableMessage(f"is a damaged colour image ({error})") from error


def rgb_of_size(message: ColourMessage, size: tuple[int, int]) -> NDArray[np.uint8]:
    """The (H, W, 3) RGB pixels of a colour image of a topic whose first is `size` (width, height) large.

    Raises:
        UndecodableMessage: the image is damaged, no colour image, or of another size.
    """
    rgb = decode_colour(message)
    if rgb.shape[:2] != size[::-1]:
        raise UndecodableMessage("is a colour image of another size than the first")
    return rgb


def _raw_rgb(message: ImageMessage) -> NDArray[np.uint8]:
    shape = message.height, message.width
    if message.encoding in _CHANNELS:
        channels, order = _CHANNELS[message.encoding]
        return pixel_rows(message, channels).reshape(*shape, channels)[..., order]
    if message.encoding in _WIDE_CHANNELS:
        upper = 0 if message.big_endian else 1
        return pixel_rows(message, 6).reshape(*shape, 3, 2)[..., _WIDE_CHANNELS[message.encoding], upper]
    if message.encoding in _CHROMA_FIRST:
        return _rgb_of_yuv422(pixel_rows(message, 2).reshape(*shape, 2), _CHROMA_FIRST[message.encoding])
    raise UndecodableMessage(f"has the encoding {message.encoding!r}, which is no known colour")


def _rgb_of_yuv422(pixels: NDArray[np.uint8], luma: int) -> NDArray[np.uint8]:
    """RGB (H, W, 3) of bytes (H, W, 2) that hold Y at `luma`, and U of even beside V of odd pixels.

    Raises:
        UndecodableMessage: the width is odd, so that a pixel lacks its other half.
    """
    if pixels.shape[1] % 2:
        raise UndecodableMessage(f"is YUV 4:2:2 of an odd width, {pixels.shape[1]} pixels")
    chroma = np.repeat(pixels[..., 1 - luma].reshape(len(pixels), -1, 2), 2, axis=1)
    yuv = np.concatenate([pixels[..., luma, None], chroma], axis=2).astype(np.float32) - [16, 128, 128]
    return np.clip(np.rint(yuv.astype(np.float32) @ _RGB_FROM_YUV.T), 0, 255).astype(np.uint8)


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
