"""Planes through the pixels of a depth image.

A surface element is a plane vector N (3,) in some camera frame: the points P with N . P = 1. It renders
along a ray d (scaled to z = 1) as the depth 1 / (N . d), moves between frames by a matrix product
(`slam.keyframes.rendering`), and a vector of zeros is the plane at infinity: the pixel that meets nothing. In
a pinhole image of a plane, inverse depth is affine in the pixel, 1/z = N . d, so that N is a linear
least-squares fit over the window's pixels that lie on the same surface.

Every round is a kernel of its own: compiled as one they run five times as long (measured, XLA's CPU backend).
"""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise
from shapes.geometry.camera import Camera
from shapes.geometry.vectors import dot
from shapes.stored_kernels import jit_stored
from slam.keyframes.depth_view import CanvasView

WINDOW_RADIUS_PX = 3
"""Chosen by hand; larger windows smooth edges, smaller ones noise (rooms of `bench slam`)."""

NEAR_BAND = 0.04
"""Relative distance from a pixel's depth within which neighbours are fitted first."""

REGION_STEPS_PX = (4, 8, 16)
"""Steps to neighbouring windows, doubling."""

REGION_TURNS = (0.08, 0.05, 0.04)
"""Rounds of averaging over ever wider surroundings, and how far orientations may differ in each."""

ON_PLANE_SIGMAS = 3.5
"""Gate of a pixel on a plane: 1 in 2,000 pixels of a Normal is lost."""

LEAST_WINDOW_PIXELS = 12
"""Four times the three parameters of a plane."""

LEAST_REGION = 300.0
"""Product of the rounds' counts of alike neighbours, at most 25 each, from which on a region is a plane."""


def region_planes(view: CanvasView, noise: DepthNoise) -> tuple[jax.Array, jax.Array]:
    """Plane vectors (3, H, W) averaged over flat regions, zeros at edges, and the regions' sizes (H, W).

    A plane has the same N everywhere, so that windows which explain each other's pixels within the noise
    may share one, offset included. It matters for views far apart that have little but a table top in
    common: noise of N passes for information on motion along it, and biases the rest. Where a region is
    small the surface may be curved: planes then pass through their own points, and the size is 1.
    """
    inverse_depth = _inverse(view.depth_m)
    tolerance = _tolerance(view.depth_m, inverse_depth, noise)
    fit = jnp.zeros((3, *inverse_depth.shape), inverse_depth.dtype)
    near = NEAR_BAND * inverse_depth
    fit, _ = _window_fit(inverse_depth, fit, view.camera, near, WINDOW_RADIUS_PX - 1)
    fit, count = _window_fit(inverse_depth, fit, view.camera, tolerance, WINDOW_RADIUS_PX)
    planes, on_plane = _fitted_planes(fit, count, inverse_depth, view.rays, tolerance)
    size = jnp.ones_like(inverse_depth)
    for step_px, turn in zip(REGION_STEPS_PX, REGION_TURNS, strict=True):
        planes, alike = _averaged(planes, on_plane, inverse_depth, view, tolerance, step_px, turn)
        size *= jnp.maximum(alike, 1.0)
    return _flat_or_own(planes, on_plane, size, inverse_depth, view.rays, tolerance)


@jax.jit
def _tolerance(depth_m: jax.Array, inverse_depth: jax.Array, noise: DepthNoise) -> jax.Array:
    """Of inverse depth, within which a pixel lies on a plane."""
    return ON_PLANE_SIGMAS * depth_noise.standard_deviation(noise, depth_m) * inverse_depth**2


@jax.jit
def _fitted_planes(
    fit: jax.Array, count: jax.Array, inverse_depth: jax.Array, rays: jax.Array, tolerance: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Planes (3, H, W) of windows, offset included, and whether (H, W) they explain their own pixels."""
    offset = inverse_depth + fit[2] - fit[0] * rays[0] - fit[1] * rays[1]
    on_plane = (inverse_depth > 0) & (count >= LEAST_WINDOW_PIXELS) & (jnp.abs(fit[2]) < tolerance)
    return jnp.stack([fit[0], fit[1], offset]), on_plane


@jax.jit
def _flat_or_own(
    planes: jax.Array,
    on_plane: jax.Array,
    size: jax.Array,
    inverse_depth: jax.Array,
    rays: jax.Array,
    tolerance: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The averaged planes where regions are large, else planes through the points; the regions' sizes."""
    on_plane &= jnp.abs(dot(planes, rays) - inverse_depth) < tolerance
    flat = on_plane & (size >= LEAST_REGION)
    planes = jnp.where(flat[None], planes, _through_points(planes[:2], inverse_depth, rays))
    return planes, jnp.where(flat, size, jnp.where(on_plane, 1.0, 0.0))


@jax.jit
def _inverse(depth_m: jax.Array) -> jax.Array:
    known = depth_m > NO_RETURN
    return jnp.where(known, 1.0 / jnp.where(known, depth_m, 1.0), 0.0)


@jax.jit
def _through_points(slopes: jax.Array, inverse_depth: jax.Array, rays: jax.Array) -> jax.Array:
    """Planes (3, H, W) of slopes (2, H, W) through the measured points, zeros elsewhere."""
    x, y = slopes
    planes = jnp.stack([x, y, inverse_depth - x * rays[0] - y * rays[1]])
    return jnp.where((inverse_depth > 0)[None], planes, 0.0)


@jit_stored(static_argnames=("step_px", "most_turn"))
def _averaged(
    planes: jax.Array,
    on_plane: jax.Array,
    inverse_depth: jax.Array,
    view: CanvasView,
    tolerance: jax.Array,
    step_px: int,
    most_turn: float,
) -> tuple[jax.Array, jax.Array]:
    """Planes (3, H, W) averaged with those of a 5 x 5 lattice around that are alike, and how many (H, W)."""
    reach, shape = 2 * step_px, inverse_depth.shape
    channels = jnp.concatenate([planes, inverse_depth[None], on_plane[None].astype(planes.dtype)])
    padded = jnp.pad(channels, ((0, 0), (reach, reach), (reach, reach)))
    steps = range(0, 2 * reach + 1, step_px)
    total, count = jnp.zeros_like(planes), jnp.zeros_like(inverse_depth)
    for row, column in itertools.product(steps, steps):
        x, y = (column - reach) / view.camera.fx, (row - reach) / view.camera.fy
        around = padded[:, row : row + shape[0], column : column + shape[1]]
        neighbour = around[:3]
        explained_by_it = jnp.abs(dot(neighbour, view.rays) - inverse_depth) < tolerance
        there = dot(planes, view.rays) + planes[0] * x + planes[1] * y
        explains_it = jnp.abs(there - around[3]) < tolerance
        turn = jnp.maximum(jnp.abs(neighbour[0] - planes[0]), jnp.abs(neighbour[1] - planes[1]))
        alike = (around[4] > 0) & explained_by_it & explains_it & (turn < most_turn * inverse_depth)
        total += jnp.where(alike[None], neighbour, 0.0)
        count += alike
    return jnp.where((count > 0)[None], total / jnp.maximum(count, 1.0)[None], planes), count


@jit_stored(static_argnames=("radius_px",))
def _window_fit(
    inverse_depth: jax.Array, fit: jax.Array, camera: Camera, tolerance: jax.Array, radius_px: int
) -> tuple[jax.Array, jax.Array]:
    """Slopes of inverse depth over the ray's x and y, and its rise over the pixel itself (3, H, W).

    Neighbours count that lie within `tolerance` (H, W) of the given `fit`; their number (H, W) is returned.
    Unrolled row by row: as a loop it runs four times as long (measured, XLA's CPU backend).
    """
    (rows, columns), side = inverse_depth.shape, 2 * radius_px + 1
    padded = jnp.pad(inverse_depth, radius_px)
    spacing_x, spacing_y = 1.0 / camera.fx, 1.0 / camera.fy
    moments = (jnp.zeros_like(inverse_depth),) * 9
    for row in range(side):
        y = (row - radius_px) * spacing_y
        of_row = (jnp.zeros_like(inverse_depth),) * 5
        for column in range(side):
            x = (column - radius_px) * spacing_x
            neighbour = padded[row : row + rows, column : column + columns]
            rise = neighbour - inverse_depth
            off_plane = jnp.abs(rise - fit[2] - fit[0] * x - fit[1] * y)
            weight = jnp.where((neighbour > 0) & (off_plane <= tolerance), 1.0, 0.0)
            of_row = _sums(of_row, (weight, weight * x, weight * (x * x), weight * rise, weight * rise * x))
        one, x, xx, rise, x_rise = of_row
        of_row = (one, x, one * y, xx, x * y, one * (y * y), rise, x_rise, rise * y)
        moments = jax.lax.optimization_barrier(_sums(moments, of_row))
    count = moments[0]
    x, y, xx, xy, yy, w, xw, yw = (moment / jnp.maximum(count, 1.0) for moment in moments[1:])
    xx, xy, yy = xx - x * x + 1e-3 * spacing_x**2, xy - x * y, yy - y * y + 1e-3 * spacing_y**2
    xw, yw = xw - x * w, yw - y * w
    determinant = xx * yy - xy * xy
    slope_x, slope_y = (yy * xw - xy * yw) / determinant, (xx * yw - xy * xw) / determinant
    return jnp.stack([slope_x, slope_y, w - slope_x * x - slope_y * y]), count


def _sums(first: tuple[jax.Array, ...], second: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    return tuple(one + other for one, other in zip(first, second, strict=True))
