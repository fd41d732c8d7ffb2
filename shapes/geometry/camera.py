"""The pinhole camera inside kernels: pixel centres are integers, +z looks forward, y points down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from recordings.types import CameraIntrinsics


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Camera:
    """Pinhole parameters in pixels as traced scalars, so that another lens compiles nothing anew."""

    fx: jax.Array
    fy: jax.Array
    cx: jax.Array
    cy: jax.Array

    @classmethod
    def from_intrinsics(cls, intrinsics: CameraIntrinsics) -> Camera:
        """The camera of a recording, in float32."""
        values = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
        return cls(*(jax.device_put(np.float32(value)) for value in values))


def stacked(cameras: Sequence[Camera]) -> Camera:
    """Cameras as one value with leaves (I,)."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)


def project(camera: Camera, x: jax.Array, y: jax.Array, z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Pixel coordinates (u, v) of points in the camera frame, elementwise; meaningful for z > 0."""
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def pixel_rays(camera: Camera, height: int, width: int) -> jax.Array:
    """Directions (H, W, 3) through the pixel centres, scaled to z = 1."""
    x = (jnp.arange(width, dtype=camera.fx.dtype) - camera.cx) / camera.fx
    y = (jnp.arange(height, dtype=camera.fy.dtype) - camera.cy) / camera.fy
    grid_x, grid_y = jnp.meshgrid(x, y)
    return jnp.stack([grid_x, grid_y, jnp.ones_like(grid_x)], axis=-1)
