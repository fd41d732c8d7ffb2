"""RVL, the run-length code for 16-bit depth images (Wilson 2017, "Fast Lossless Depth Image Compression").

The code is a stream of numbers of any length, three bits a nibble from the lowest, the fourth bit set
while more follow; nibbles fill little-endian 32-bit words from the top. The numbers are runs: how many
zeros, how many non-zeros, then for each of these its zigzagged difference to the one before it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.messages.types import UndecodableMessage

_LONGEST_NUMBER = 11  # nibbles of a 32-bit number
_LONGEST_CODE = 4
"""Bytes a pixel: six nibbles of a difference of 16 bits, and two of the runs where each pixel is one."""
_SLACK = 64
_SHIFTS = np.arange(28, -1, -4, dtype=np.uint32)


def decode_rvl(data: bytes, pixels: int) -> NDArray[np.uint16]:
    """The (pixels,) values of an image; the caller has checked that many to be reasonable.

    Raises:
        UndecodableMessage: the code ends early or gives another number of pixels.
    """
    numbers = _numbers(data[: _LONGEST_CODE * pixels + _SLACK])
    zeros, non_zeros, is_difference = _runs(numbers, pixels)
    zigzag = numbers[is_difference]
    values = np.cumsum((zigzag >> 1) ^ -(zigzag & 1)).astype(np.uint16)
    lengths = np.column_stack([zeros, non_zeros]).ravel()
    image = np.zeros(pixels, np.uint16)
    image[np.repeat(np.arange(lengths.size) % 2 == 1, lengths)] = values
    return image


def _numbers(data: bytes) -> NDArray[np.int64]:
    words = np.frombuffer(data, "<u4", len(data) // 4)
    nibbles = ((words[:, None] >> _SHIFTS) & 0xF).ravel().astype(np.int64)
    ends = np.flatnonzero(nibbles < 8)
    if ends.size == 0:
        raise UndecodableMessage("has an RVL code without a number")
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(ends[-1] + 1) - np.repeat(starts, ends - starts + 1)
    if place.max() >= _LONGEST_NUMBER:
        raise UndecodableMessage("has an RVL code with a number of more than 32 bits")
    return np.add.reduceat((nibbles[: ends[-1] + 1] & 7) << (3 * place), starts)


def _runs(numbers: NDArray[np.int64], pixels: int) -> tuple[list[int], list[int], NDArray[np.bool_]]:
    """Lengths of the runs of zeros and non-zeros, and which numbers are differences."""
    values = numbers.tolist()
    zeros: list[int] = []
    non_zeros: list[int] = []
    heads: list[int] = []
    position = decoded = 0
    while decoded < pixels:
        if position + 1 >= len(values):
            raise UndecodableMessage(f"has an RVL code for {decoded} of {pixels} pixels")
        heads.append(position)
        zeros.append(values[position])
        non_zeros.append(values[position + 1])
        decoded += zeros[-1] + non_zeros[-1]
        position += 2 + non_zeros[-1]
        if zeros[-1] + non_zeros[-1] == 0:
            raise UndecodableMessage("has an RVL code with an empty run")
    if decoded > pixels or position > len(values):
        raise UndecodableMessage(f"has an RVL code for {decoded} instead of {pixels} pixels")
    is_difference = np.zeros(len(values), np.bool_)
    is_difference[:position] = True
    is_difference[heads] = is_difference[np.add(heads, 1)] = False
    return zeros, non_zeros, is_difference
