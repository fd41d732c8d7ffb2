"""A depth image at the search's resolution: pooled pixels and surface normals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from recordings.types import NO_RETURN, CameraIntrinsics
from scene.execution import FAST_COMPILE
from shapes.geometry.camera import Camera

NORMAL_WINDOW = 2
"""Half width in pixels of the window to which a tangent plane is fitted."""

SAME_SURFACE_M = 0.02
"""Pixels of the window that differ more in depth belong to another surface."""

FEWEST_PIXELS = 8


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PooledView:
    """A pooled depth image.

    Attributes:
        camera: of the pooled pixels.
        depth_m: (H, W) float32, `NO_RETURN` where nothing was measured.
        normals: (H, W, 3) float32, unit and towards the camera; zero where they are unknown.
        unexplained: (H, W) bool, pixels that wait for an object to show: neither table nor background.
    """

    camera: Camera
    depth_m: jax.Array
    normals: jax.Array
    unexplained: jax.Array

    @property
    def points_m(self) -> NDArray[np.float64]:
        """Points (H, W, 3) in the camera frame."""
        return unproject(np.asarray(self.depth_m), self.camera)


def pooled_view(depth_m: NDArray[np.float32], intrinsics: CameraIntrinsics, width: int) -> PooledView:
    """The view with about `width` columns: medians of square blocks, and their normals."""
    factor = max(1, round(intrinsics.width / width))
    pooled = _median_pool(depth_m, factor)
    rows, columns = pooled.shape
    whole_blocks = replace(intrinsics, width=columns * factor, height=rows * factor)
    camera = Camera.from_intrinsics(whole_blocks.resized(columns, rows))
    normals = _normals(pooled, camera)
    assert normals.shape == (rows, columns, 3)
    return PooledView(camera, jax.device_put(pooled), normals, jax.device_put(pooled != NO_RETURN))


def project(
    points_m: NDArray[np.float64], camera: CameraIntrinsics | Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Row and column of points (..., 3) in the camera frame, and whether they are before the camera."""
    x, y, z = np.moveaxis(points_m, -1, 0)
    ahead = z > 0
    z = np.where(ahead, z, np.inf)
    return y / z * float(camera.fy) + float(camera.cy), x / z * float(camera.fx) + float(camera.cx), ahead


def pixels_at(
    points_m: NDArray[np.float64], camera: CameraIntrinsics | Camera, shape: tuple[int, ...]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Row and column of camera points (..., 3) in an image (H, W), 0 outside it; whether they are inside."""
    *places, ahead = project(points_m, camera)
    row, column = map(np.rint, places)
    inside = ahead & (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    rows, columns = (np.where(inside, place, 0).astype(np.intp) for place in (row, column))
    return rows, columns, inside


def unproject(depth_m: NDArray[np.float32], camera: CameraIntrinsics | Camera) -> NDArray[np.float64]:
    """Points (H, W, 3) in the camera frame."""
    columns = (np.arange(depth_m.shape[1]) - float(camera.cx)) / float(camera.fx)
    rows = (np.arange(depth_m.shape[0]) - float(camera.cy)) / float(camera.fy)
    rays = np.stack(np.broadcast_arrays(columns[None, :], rows[:, None], 1.0), axis=-1)
    return rays * depth_m[..., None].astype(np.float64)


def _median_pool(depth_m: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Lower median of the measured pixels of each block."""
    rows, columns = depth_m.shape[0] // factor, depth_m.shape[1] // factor
    blocks = depth_m[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
    blocks = blocks.transpose(0, 2, 1, 3).reshape(rows, columns, factor**2)
    measured = np.sort(np.where(blocks == NO_RETURN, np.inf, blocks), axis=-1)
    count = np.isfinite(measured).sum(axis=-1)
    middle = np.take_along_axis(measured, np.maximum((count - 1) // 2, 0)[..., None], axis=-1)[..., 0]
    return np.where(count > 0, middle, NO_RETURN).astype(np.float32)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _normals(depth_m: jax.Array, camera: Camera) -> jax.Array:
    """Tangent planes by least squares: on a plane, inverse depth is linear in the pixel's place."""
    height, width = depth_m.shape
    radius = NORMAL_WINDOW
    padded = jnp.pad(depth_m, radius)
    inverse = jnp.where(depth_m > 0, 1 / jnp.maximum(depth_m, 1e-3), 0.0)
    sums = (jnp.zeros_like(depth_m),) * 9
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            near = padded[radius + dy : radius + dy + height, radius + dx : radius + dx + width]
            use = ((near > 0) & (jnp.abs(near - depth_m) < SAME_SURFACE_M)).astype(depth_m.dtype)
            sums = with_pixel(sums, 1 / jnp.maximum(near, 1e-3) - inverse, use, dx, dy)
    _, slope_x, slope_y = solved_plane(sums, 1e-3, 1.0)
    columns, rows = jnp.meshgrid(jnp.arange(width) - camera.cx, jnp.arange(height) - camera.cy)
    along = inverse - slope_x * columns - slope_y * rows
    normal = -jnp.stack([slope_x * camera.fx, slope_y * camera.fy, along], axis=-1)
    normal = normal / jnp.maximum(jnp.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    return jnp.where(((depth_m > 0) & (sums[0] >= FEWEST_PIXELS))[..., None], normal, 0.0)


Sums = tuple[jax.Array, ...]
"""Of the normal equations of planes in inverse depth, one a pixel: nine arrays."""


def with_pixel(sums: Sums, value: jax.Array, use: jax.Array, across: ArrayLike, down: ArrayLike) -> Sums:
    """The sums with one more pixel of each, so far to its right and below it: values and weights (H, W)."""
    x, y = jnp.asarray(across, value.dtype), jnp.asarray(down, value.dtype)
    terms = (1.0, x, y, x * x, x * y, y * y, value, x * value, y * value)
    return tuple(total + use * term for total, term in zip(sums, terms, strict=True))


def solved_plane(sums: Sums, stiffness: float, least: float) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Value here and slopes right and down (H, W) of least-squares planes; 0 without any pixel.

    Args:
        sums: of the pixels round each.
        stiffness: added to the normal equations of slopes, in pixels squared: few pixels tell of no slope.
        least: weight of all pixels together.
    """
    count, x, y, xx, xy, yy, d, xd, yd = sums
    n = jnp.maximum(count, least)
    xx, xy, yy = xx - x * x / n + stiffness, xy - x * y / n, yy - y * y / n + stiffness
    xd, yd = xd - x * d / n, yd - y * d / n
    determinant = xx * yy - xy**2
    slope_x, slope_y = (yy * xd - xy * yd) / determinant, (xx * yd - xy * xd) / determinant
    return (d - slope_x * x - slope_y * y) / n, slope_x, slope_y
