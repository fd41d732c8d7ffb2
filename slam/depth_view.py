"""The working image of a frame: block-reduced depth on a canvas of one fixed size, and its tangent planes.

A surface element is a plane vector N (3,) in some camera frame: the points P with N . P = 1. It renders
along a ray d (scaled to z = 1) as the depth 1 / (N . d), moves between frames by a matrix product
(`slam.rendering`), and a vector of zeros is the plane at infinity: the pixel that meets nothing.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, CameraIntrinsics, Frame
from shapes.camera import Camera, pixel_rays

CANVAS_HEIGHT = 120
CANVAS_WIDTH = 160
BLOCK_DEPTH_BAND = 0.03
"""Relative depth band that counts as one surface when a block of pixels is averaged."""
PLANE_WINDOW_RADIUS_PX = 3
PLANE_DEPTH_BANDS = (0.04, 0.01)
"""Relative distances from a pixel's tangent plane within which neighbours belong to it, pass by pass."""

WIDE_STEPS, WIDE_STEP_PX = 2, 4
WIDE_TURN = 0.06
"""Difference in orientation, radians, within which two windows lie on one plane."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DepthView:
    """One frame at working resolution.

    Attributes:
        depth_m: (CANVAS_HEIGHT, CANVAS_WIDTH) float32 along the optical axis, `NO_RETURN` where unknown.
        measured: the same shape, bool: the pixels that the image has (the canvas may be larger).
        rays: (3, CANVAS_HEIGHT, CANVAS_WIDTH) directions through the pixel centres, scaled to z = 1.
        camera: intrinsics at working resolution.
    """

    depth_m: jax.Array
    measured: jax.Array
    rays: jax.Array
    camera: Camera


def framing(view: DepthView) -> NDArray[np.float64]:
    """What the view's image takes in (6,): fx, fy, cx, cy, columns, rows, in pixels."""
    camera = view.camera
    rows, columns = np.argwhere(np.asarray(view.measured)).max(axis=0) + 1
    return np.asarray([camera.fx, camera.fy, camera.cx, camera.cy, columns, rows], float)


def reduction_factor(intrinsics: CameraIntrinsics) -> int:
    """Side in pixels of the square blocks that bring an image onto the canvas."""
    return max(1, -(-intrinsics.width // CANVAS_WIDTH), -(-intrinsics.height // CANVAS_HEIGHT))


def view_of_frame(frame: Frame, intrinsics: CameraIntrinsics) -> DepthView:
    """The working image of a frame; a frame of another size than `intrinsics` is taken as a resized one."""
    height, width = frame.depth_m.shape
    if (height, width) != (intrinsics.height, intrinsics.width):
        intrinsics = intrinsics.resized(width, height)
    factor = reduction_factor(intrinsics)
    rows, columns = -(-height // factor), -(-width // factor)
    padded: NDArray[np.float32] = np.full((rows * factor, columns * factor), NO_RETURN, np.float32)
    padded[:height, :width] = frame.depth_m
    whole_blocks = replace(intrinsics, width=columns * factor, height=rows * factor)
    camera = Camera.from_intrinsics(whole_blocks.resized(columns, rows))
    return _reduce(padded, camera, factor)


@partial(jax.jit, static_argnames="factor")
def _reduce(depth_m: jax.Array, camera: Camera, factor: int) -> DepthView:
    reduced = block_reduce(depth_m, factor)
    rows, columns = reduced.shape
    padding = ((0, CANVAS_HEIGHT - rows), (0, CANVAS_WIDTH - columns))
    return DepthView(
        depth_m=jnp.pad(reduced, padding),
        measured=jnp.pad(jnp.ones((rows, columns), bool), padding),
        rays=jnp.moveaxis(pixel_rays(camera, CANVAS_HEIGHT, CANVAS_WIDTH), -1, 0),
        camera=camera,
    )


def block_reduce(depth_m: jax.Array, factor: int) -> jax.Array:
    """Depth (H, W) averaged over `factor` x `factor` blocks, each over its nearest surface alone.

    A block whose nearest surface covers less than half of it has no return: it has no one depth.
    """
    block = [depth_m[row::factor, column::factor] for row in range(factor) for column in range(factor)]
    nearest = reduce(jnp.minimum, [jnp.where(pixel > NO_RETURN, pixel, jnp.inf) for pixel in block])
    farthest = (1.0 + BLOCK_DEPTH_BAND) * nearest
    on_surface = [(pixel > NO_RETURN) & (pixel <= farthest) for pixel in block]
    count = reduce(add, [member.astype(jnp.int32) for member in on_surface])
    total = reduce(add, [jnp.where(*pair, 0.0) for pair in zip(on_surface, block, strict=True)])
    return jnp.where(2 * count >= factor * factor, total / jnp.maximum(count, 1), NO_RETURN)


def tangent_planes(depth_m: jax.Array, rays: jax.Array, camera: Camera) -> jax.Array:
    """Plane vectors (3, H, W) through each measured point, oriented by its window; zeros elsewhere.

    In a pinhole image of a plane, inverse depth is affine in the pixel, 1/z = N . d, so N is a
    least-squares fit over the window's pixels that lie on the same surface. A second pass drops the
    pixels that the first plane does not explain, which keeps creases sharp. Only the orientation is
    smoothed: planes that do not pass through their points round the creases (measured: millimetres).
    """
    known = depth_m > NO_RETURN
    inverse_depth = jnp.where(known, 1.0 / jnp.where(known, depth_m, 1.0), 0.0)
    fit = jnp.zeros((3, *depth_m.shape), depth_m.dtype)
    for band in PLANE_DEPTH_BANDS:
        fit = _window_fit(inverse_depth, fit, camera, band)
    slope_x, slope_y = _widened(fit[:2], inverse_depth, camera)
    offset = inverse_depth - slope_x * rays[0] - slope_y * rays[1]
    return jnp.where(known[None], jnp.stack([slope_x, slope_y, offset]), 0.0)


def _widened(slopes: jax.Array, inverse_depth: jax.Array, camera: Camera) -> jax.Array:
    """Slopes (2, H, W) averaged with those of alike, coplanar pixels a few windows around.

    A plane has the same N everywhere, so that noise averages out over all of it. It matters: along a bare
    wall noise of N passes for information on motion that leaves no trace.
    """
    reach, shape = WIDE_STEPS * WIDE_STEP_PX, inverse_depth.shape
    padded = jnp.pad(jnp.concatenate([slopes, inverse_depth[None]]), ((0, 0), (reach, reach), (reach, reach)))
    steps = range(0, 2 * reach + 1, WIDE_STEP_PX)
    total, weight = jnp.zeros_like(slopes), jnp.zeros_like(inverse_depth)
    for row, column in itertools.product(steps, steps):
        x, y = (column - reach) / camera.fx, (row - reach) / camera.fy
        around = padded[:, row : row + shape[0], column : column + shape[1]]
        off_plane = jnp.abs(around[2] - inverse_depth - slopes[0] * x - slopes[1] * y)
        turn = jnp.maximum(jnp.abs(around[0] - slopes[0]), jnp.abs(around[1] - slopes[1]))
        alike = (around[2] > 0) & (turn < WIDE_TURN * inverse_depth)
        alike &= off_plane <= PLANE_DEPTH_BANDS[-1] * inverse_depth
        total += jnp.where(alike[None], around[:2], 0.0)
        weight += alike
    return total / jnp.maximum(weight, 1.0)[None]


def _window_fit(inverse_depth: jax.Array, fit: jax.Array, camera: Camera, band: float) -> jax.Array:
    """Slopes of inverse depth over the ray's x and y, and its rise over the pixel itself (3, H, W).

    Neighbours count that lie within `band`, relative to inverse depth, of the given `fit`.
    """
    radius, shape = PLANE_WINDOW_RADIUS_PX, inverse_depth.shape
    padded = jnp.pad(inverse_depth, radius)
    spacing_x, spacing_y = 1.0 / camera.fx, 1.0 / camera.fy

    def accumulate(moments: jax.Array, corner: jax.Array) -> tuple[jax.Array, None]:
        row, column = corner
        x = (column - radius).astype(inverse_depth.dtype) * spacing_x
        y = (row - radius).astype(inverse_depth.dtype) * spacing_y
        neighbour = jax.lax.dynamic_slice(padded, (row, column), shape)
        rise = neighbour - inverse_depth
        off_plane = jnp.abs(rise - fit[2] - fit[0] * x - fit[1] * y)
        weight = jnp.where((neighbour > 0) & (off_plane <= band * inverse_depth), 1.0, 0.0)
        weighted_rise = weight * rise
        terms = [weight, weight * x, weight * y, weight * (x * x), weight * (x * y), weight * (y * y)]
        return moments + jnp.stack([*terms, weighted_rise, x * weighted_rise, y * weighted_rise]), None

    side = jnp.arange(2 * radius + 1)
    corners = jnp.stack(jnp.meshgrid(side, side), axis=-1).reshape(-1, 2)
    moments, _ = jax.lax.scan(accumulate, jnp.zeros((9, *shape), inverse_depth.dtype), corners)
    x, y, xx, xy, yy, w, xw, yw = moments[1:] / jnp.maximum(moments[:1], 1.0)
    xx, xy, yy = xx - x * x + 1e-3 * spacing_x**2, xy - x * y, yy - y * y + 1e-3 * spacing_y**2
    xw, yw = xw - x * w, yw - y * w
    determinant = xx * yy - xy * xy
    slope_x, slope_y = (yy * xw - xy * yw) / determinant, (xx * yw - xy * xw) / determinant
    return jnp.stack([slope_x, slope_y, w - slope_x * x - slope_y * y])
