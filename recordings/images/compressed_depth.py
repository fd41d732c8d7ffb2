"""Compressed depth images: 16-bit PNG, and the ROS transport `compressedDepth` with PNG or RVL.

A compressedDepth message starts with twelve bytes: an enumeration and two floats A, B. 16-bit depth
follows as it is; floating-point depth d is stored as the 16-bit inverse A / d + B, 0 for no return
(image_transport_plugins, compressed_depth_image_transport/src/codec.cpp).
"""

from __future__ import annotations

import io
import struct

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from recordings.images.depth_pixels import MAX_PIXELS
from recordings.images.rvl import decode_rvl
from recordings.messages.types import CompressedImageMessage, UndecodableMessage

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_HEAD = struct.Struct(">8xI4sIIBB")  # signature, length, "IHDR", width, height, bit depth, colour type
_TRANSPORT_HEAD = struct.Struct("<iff")
_RVL_SIZE = struct.Struct("<II")
_GREY = 0


def holds_depth(message: CompressedImageMessage) -> bool:
    """Whether a compressed image is depth: by the transport's name, or as a PNG of 16-bit grey values."""
    return _is_transport(message) or _is_grey16_png(message.data)


def stored_depth(message: CompressedImageMessage) -> NDArray[np.uint16] | NDArray[np.float32]:
    """The (H, W) depths in the unit of the image: integers as stored, floats in metres.

    Raises:
        UndecodableMessage: the image is damaged, too large or no depth.
    """
    if not _is_transport(message):
        return decode_grey16_png(message.data)
    if len(message.data) <= _TRANSPORT_HEAD.size:
        raise UndecodableMessage("is an empty compressedDepth image")
    _, a, b = _TRANSPORT_HEAD.unpack_from(message.data)
    payload = message.data[_TRANSPORT_HEAD.size :]
    stored = decode_grey16_png(payload) if payload.startswith(_PNG) else _decode_sized_rvl(payload)
    if not message.format.startswith("32FC1"):
        return stored
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = np.float32(a) / (stored.astype(np.float32) - np.float32(b))
    return np.where(stored == 0, np.float32(np.nan), depth_m)


def decode_grey16_png(data: bytes) -> NDArray[np.uint16]:
    """The (H, W) values of a PNG of 16-bit grey values.

    Raises:
        UndecodableMessage: it is another kind of image, damaged or too large.
    """
    if not _is_grey16_png(data):
        raise UndecodableMessage("is not a PNG of 16-bit grey values")
    _, _, width, height, _, _ = _PNG_HEAD.unpack_from(data)
    if not 0 < width * height <= MAX_PIXELS:
        raise UndecodableMessage(f"claims to be an image of {width}x{height} pixels")
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as image:
            return np.asarray(image, np.uint16)
    except Exception as error:  # Pillow raises half a dozen kinds on damaged images, SyntaxError among them
        raise UndecodableMessage(f"is a damaged PNG ({error})") from error


def image_size(message: CompressedImageMessage) -> tuple[int, int]:
    """Width and height that a depth image claims, without decoding it.

    Raises:
        UndecodableMessage: the image is cut off before it says so.
    """
    payload = message.data[_TRANSPORT_HEAD.size :] if _is_transport(message) else message.data
    if payload.startswith(_PNG) and len(payload) >= _PNG_HEAD.size:
        _, _, width, height, _, _ = _PNG_HEAD.unpack_from(payload)
    elif len(payload) >= _RVL_SIZE.size:
        width, height = _RVL_SIZE.unpack_from(payload)
    else:
        raise UndecodableMessage("is cut off before its size")
    if not 0 < width * height <= MAX_PIXELS:
        raise UndecodableMessage(f"claims to be an image of {width}x{height} pixels")
    return width, height


def _is_transport(message: CompressedImageMessage) -> bool:
    return "compressedDepth" in message.format or message.data[_TRANSPORT_HEAD.size :].startswith(_PNG)


def _is_grey16_png(data: bytes) -> bool:
    if not data.startswith(_PNG) or len(data) < _PNG_HEAD.size:
        return False
    *_, bit_depth, colour_type = _PNG_HEAD.unpack_from(data)
    return (bit_depth, colour_type) == (16, _GREY)


def _decode_sized_rvl(data: bytes) -> NDArray[np.uint16]:
    if len(data) < _RVL_SIZE.size:
        raise UndecodableMessage("is cut off before its size")
    width, height = _RVL_SIZE.unpack_from(data)
    if not 0 < width * height <= MAX_PIXELS:
        raise UndecodableMessage(f"claims to be an image of {width}x{height} pixels")
    return decode_rvl(data[_RVL_SIZE.size :], width * height).reshape(height, width)
