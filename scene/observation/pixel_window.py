"""The pixels of an image on which scenes are compared: a grid over all of it."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics
from shapes.geometry.camera import Camera

PITCH_RAD = 1 / 140
"""Angle from one compared pixel to the next, 6 mm at 0.8 m: four pixels of a camera with 640 across, whose
errors are alike (correlation 0.5 at four)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelWindow:
    """Every `stride`-th pixel of an image; its rays are those of the image, nothing is resampled.

    Attributes:
        camera: of the window's own pixel coordinates.
        stride: pixels of the image from one of the window to the next.
        depth_m: (H, W) float32.
        rows, columns: (H,) and (W,) of the image.
    """

    camera: Camera
    stride: int
    depth_m: NDArray[np.float32]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]

    def of(self, image: NDArray) -> NDArray:
        """The window's pixels of an image-sized array."""
        return image[np.ix_(self.rows, self.columns)]


def stride_of(intrinsics: CameraIntrinsics) -> int:
    """Pixels of an image from one compared pixel to the next."""
    return max(1, round(intrinsics.fx * PITCH_RAD))


def compared(shape: tuple[int, ...], stride: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of an image of a shape (H, W) on which scenes are compared."""
    height, width = shape
    return np.arange(height % stride // 2, height, stride), np.arange(width % stride // 2, width, stride)


def window_of(depth_m: NDArray[np.float32], intrinsics: CameraIntrinsics) -> PixelWindow:
    """The pixels of an image (H, W) on which scenes are compared.

    Which ones they are is the camera's alone: what is told of a thing does not depend on what else is seen.
    """
    stride = stride_of(intrinsics)
    rows, columns = compared(depth_m.shape, stride)
    focal_px = intrinsics.fx / stride, intrinsics.fy / stride
    centre_px = (intrinsics.cx - columns[0]) / stride, (intrinsics.cy - rows[0]) / stride
    camera = Camera(*(jax.device_put(np.float32(value)) for value in (*focal_px, *centre_px)))
    measured = depth_m[np.ix_(rows, columns)]
    return PixelWindow(camera=camera, stride=stride, depth_m=measured, rows=rows, columns=columns)
