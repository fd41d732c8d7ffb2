"""Parts of images that hold what objects cover: most cover a hundredth of an image."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.likelihood.causal_planes import LEANING_PX

SIZES = (32, 40), (64, 72)
"""Rows and columns of crops: what lies within none of them takes all of the image. Of an object 25 cm high at
0.8 m there are 43 rows."""

LINES_BESIDE = 3, LEANING_PX + 3
"""Rows and columns on either side of a layer that its density looks at: what is beside its outline, whether
an outline is before that, and what foretells it."""

PIXELS_TOGETHER, LEAST_TOGETHER, MOST_TOGETHER = 2**17, 4, 64
"""Pixels of a kernel, and the least and most crops: kernels run side by side, each on a core. Speed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Crops:
    """Crops of one size, of some of many images.

    Attributes:
        members: (n,) which images.
        corners: (n, 2) int32 first rows and columns.
        size: rows and columns.
    """

    members: NDArray[np.intp]
    corners: NDArray[np.int32]
    size: tuple[int, int]

    def taken(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """Crops (n, h, w) of images (N, H, W)."""
        return np.stack([images[part] for part in self._parts()])

    def of(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """The crops (n, h, w) as they lie in one image (H, W)."""
        return np.stack([image[part[1:]] for part in self._parts()])

    def put(self, images: NDArray[np.float32], crops: NDArray[np.float32]) -> None:
        """Write crops (n, h, w), or the first of more, into images (N, H, W)."""
        for part, crop in zip(self._parts(), crops, strict=False):
            images[part] = crop

    def filled(self, values: NDArray) -> NDArray:
        """Values (n, ...) of members, filled up to `most_members` with the first: one kernel serves any n."""
        numbers = np.arange(most_members(self.size))
        return values[np.where(numbers < len(values), numbers, 0)]

    def _parts(self) -> Iterator[tuple[int, slice, slice]]:
        height, width = self.size
        for one, (row, column) in zip(self.members.tolist(), self.corners.tolist(), strict=True):
            yield one, slice(row, row + height), slice(column, column + width)


def crop_sizes(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Sizes of crops of images (H, W), the smallest first; the last is theirs."""
    height, width = shape
    return [*(size for size in SIZES if size[0] < height and size[1] < width), (height, width)]


def most_members(size: tuple[int, ...]) -> int:
    """Most crops of a size that one kernel takes."""
    return min(max(PIXELS_TOGETHER // (size[0] * size[1]), LEAST_TOGETHER), MOST_TOGETHER)


def lines_around(covered: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First rows and columns (n, 2) of what masks (n, H, W) hold with `LINES_BESIDE`, and those after them.

    These are 0 where a mask holds nothing.
    """
    first, after = [], []
    for axis, beside in zip((2, 1), LINES_BESIDE, strict=True):
        lines = np.asarray(covered.any(axis=axis))
        last = lines.shape[1] - lines[:, ::-1].argmax(axis=1)
        first.append(np.maximum(lines.argmax(axis=1) - beside, 0))
        after.append(np.where(lines.any(axis=1), np.minimum(last + beside, lines.shape[1]), 0))
    return np.stack(first, axis=1), np.stack(after, axis=1)


def crops_around(first: NDArray[np.intp], after: NDArray[np.intp], shape: tuple[int, ...]) -> Iterator[Crops]:
    """The smallest crops that hold what begins at rows and columns (n, 2) and ends before others (n, 2).

    There are none of what ends at 0.

    Args:
        first: rows and columns.
        after: those after the last.
        shape: (H, W) of the images.
    """
    left = (after > 0).all(axis=1)
    for size in crop_sizes(shape):
        inside = left & (after - first <= size).all(axis=1)
        left &= ~inside
        members = np.flatnonzero(inside)
        corners, most = np.minimum(first, np.subtract(shape, size)).astype(np.int32), most_members(size)
        for one in range(0, len(members), most):
            mine = members[one : one + most]
            yield Crops(members=mine, corners=corners[mine], size=size)
