"""Raw depth images: 16UC1, mono16 and 32FC1 with any row padding and byte order, to metres.

ROS REP 118: 16-bit integers are millimetres with 0 for no return; floats are metres with NaN for no
return and infinities for out of range.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.messages.types import ImageMessage, UndecodableMessage
from recordings.types import NO_RETURN

DEPTH_DTYPES = {"16UC1": np.dtype("u2"), "mono16": np.dtype("u2"), "32FC1": np.dtype("f4")}
"""Encodings that hold one depth a pixel."""
MAX_PIXELS = 1 << 25
"""Largest image that memory is taken for: 8192 x 4096, more than any depth camera has."""

MILLIMETRE_M = 0.001
"""Unit of 16-bit depth by REP 118."""
_SATURATED = 65535
_FARTHEST_M = 1000.0
"""No depth camera sees farther: some write the largest float, or such, where they measured nothing."""


def stored_pixels(message: ImageMessage) -> NDArray[np.uint16] | NDArray[np.float32]:
    """The (H, W) numbers of a raw image, a view of the message where the machine's byte order allows.

    Raises:
        UndecodableMessage: the encoding holds no depth, or the sizes contradict the data.
    """
    dtype = DEPTH_DTYPES.get(message.encoding)
    if dtype is None:
        raise UndecodableMessage(f"has the encoding {message.encoding!r}, which is no depth")
    rows = pixel_rows(message, dtype.itemsize)
    return rows.view(dtype.newbyteorder(">" if message.big_endian else "<"))


def pixel_rows(message: ImageMessage, pixel_size: int) -> NDArray[np.uint8]:
    """The bytes (H, W * pixel_size) of a raw image without the padding of its rows.

    Raises:
        UndecodableMessage: the sizes contradict the data.
    """
    width, height, step = message.width, message.height, message.step
    if not (width > 0 < height and width * height <= MAX_PIXELS):
        raise UndecodableMessage(f"claims to be an image of {width}x{height} pixels")
    if step < width * pixel_size or len(message.data) < step * (height - 1) + width * pixel_size:
        raise UndecodableMessage(
            f"has {len(message.data)} bytes for {height} rows of {step}, {width} pixels of {pixel_size} each"
        )
    if len(message.data) < step * height:  # some writers leave out the last row's padding
        missing = bytes(step * height - len(message.data))
        return np.frombuffer(message.data + missing, np.uint8).reshape(height, step)[:, : width * pixel_size]
    pixels = np.frombuffer(message.data, np.uint8, step * height).reshape(height, step)
    return pixels[:, : width * pixel_size]


class MetricDepth:
    """Turns stored depths into float32 metres, with `NO_RETURN` for everything that measured nothing.

    Zero, negative, NaN, infinite and saturated values (65535, a kilometre) measured nothing.

    Args:
        scale_m: metres for a stored 1; by default `unit_m` for integers and 1 for floats.
        unit_m: of integers.
    """

    def __init__(self, scale_m: float | None = None, unit_m: float = MILLIMETRE_M) -> None:
        # Dividing by 1000 rounds correctly where multiplying by 0.001 does not.
        self._units_per_m = {"u": np.float32(1 / (scale_m or unit_m)), "f": np.float32(1 / (scale_m or 1.0))}

    def __call__(self, stored: NDArray[np.uint16] | NDArray[np.float32]) -> NDArray[np.float32]:
        """Depths (H, W) in metres."""
        kind = stored.dtype.kind
        # By default the metres would name the message's byte order in their type, which Open3D refuses.
        depth_m = np.divide(stored, self._units_per_m[kind], out=np.empty(stored.shape, np.float32))
        if kind == "f":
            depth_m[~((depth_m > 0) & (depth_m < _FARTHEST_M))] = NO_RETURN
        elif stored.max() == _SATURATED:
            depth_m[stored == _SATURATED] = NO_RETURN
        return depth_m
