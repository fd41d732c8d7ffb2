"""The part of an image in which scenes are compared: a grid of original pixels over the foreground."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, CameraIntrinsics
from shapes.geometry.camera import Camera

WINDOW_HEIGHT, WINDOW_WIDTH = 72, 96

MARGIN_PX = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelWindow:
    """Every `stride`-th pixel of a rectangle; its rays are those of the image, nothing is resampled.

    Attributes:
        camera: of the window's own pixel coordinates.
        depth_m: (H, W) float32; `NO_RETURN` also beyond the image.
        inside: the same shape, bool, False beyond the image.
        rows, columns: of the image.
    """

    camera: Camera
    depth_m: NDArray[np.float32]
    inside: NDArray[np.bool_]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]

    @property
    def stride(self) -> int:
        """Pixels of the image from one of the window to the next."""
        return int(self.rows[1] - self.rows[0])

    def of(self, image: NDArray) -> NDArray:
        """The window's pixels of an image-sized array."""
        height, width = image.shape[:2]
        return image[np.clip(self.rows, 0, height - 1)[:, None], np.clip(self.columns, 0, width - 1)]


def window_over(
    foreground: NDArray[np.bool_],
    depth_m: NDArray[np.float32],
    intrinsics: CameraIntrinsics,
) -> PixelWindow:
    """The finest window that holds the foreground pixels."""
    places = np.argwhere(foreground) if foreground.any() else np.zeros((1, 2), np.int64)
    low, high = places.min(axis=0), places.max(axis=0) + 1
    size = np.array([WINDOW_HEIGHT, WINDOW_WIDTH])
    stride = max(1, int(np.ceil(((high - low) / (size - 2 * MARGIN_PX)).max())))
    first = (low + high - stride * size) // 2
    at_rows, at_columns = (first[axis] + stride * np.arange(size[axis]) for axis in (0, 1))
    inside_rows = (at_rows >= 0) & (at_rows < intrinsics.height)
    inside_columns = (at_columns >= 0) & (at_columns < intrinsics.width)
    inside = inside_rows[:, None] & inside_columns
    camera = Camera(
        *(
            jax.device_put(np.float32(value))
            for value in (
                intrinsics.fx / stride,
                intrinsics.fy / stride,
                (intrinsics.cx - first[1]) / stride,
                (intrinsics.cy - first[0]) / stride,
            )
        )
    )
    window = PixelWindow(
        camera=camera,
        depth_m=np.zeros(inside.shape, np.float32),
        inside=inside,
        rows=at_rows,
        columns=at_columns,
    )
    measured = np.where(inside, window.of(depth_m), NO_RETURN).astype(np.float32)
    return PixelWindow(camera=camera, depth_m=measured, inside=inside, rows=at_rows, columns=at_columns)
