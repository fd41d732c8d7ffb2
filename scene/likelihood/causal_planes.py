"""Planes through the pixels before each one in raster order, by least squares."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from recordings.types import NO_RETURN
from scene.observation.depth_view import Sums, solved_plane, with_pixel

ROWS_BEFORE, COLUMNS_BESIDE = 2, 2
"""The pixels before one to which planes are fitted: so many rows above, so many columns to either side."""
LEANING_PX = 4
"""The columns to the right, in the row above, among which an outline that leans to the left is looked for:
held-out pixels of a kitchen, a shelf and YCB-Video have mean log densities of 3.921, 4.359, 4.831 with one
column, 3.924, 4.473, 4.834 with four."""
WIDE_PX, NEAR_SIGMAS = 6, 4.0
"""A surface's slopes are those of its pixels up to so many rows above and columns beside, so far from the
plane through those near by, in standard deviations of the sensor."""
STIFFNESS, LEAST_COUNT = 0.5, 1e-3
"""Added to the normal equations of slopes, in pixels squared, and the least weight of all: few pixels tell
of no slope."""


def fitted(before: Callable[[int, int], tuple[jax.Array, jax.Array]]) -> tuple[jax.Array, ...]:
    """The least-squares plane through the pixels before each: value (H, W) there, slopes right and down.

    Args:
        before: values and weights (H, W) of the pixels so many rows above and columns to the left of each.
    """
    sums: Sums = (jnp.zeros(()),) * 9
    for down in range(ROWS_BEFORE + 1):
        for across in range(1 if down == 0 else -COLUMNS_BESIDE, COLUMNS_BESIDE + 1):
            sums = with_pixel(sums, *before(down, across), -across, -down)
    return solved_plane(sums, STIFFNESS, LEAST_COUNT)


def shifted(image: jax.Array, down: int, across: int) -> jax.Array:
    """The pixel so far above and to the left (or right) of each, `NO_RETURN` beyond the border."""
    return shifts(image)(down, across)


def shifts(image: jax.Array) -> Callable[[int, int], jax.Array]:
    """Pixels (H, W, ...) so many rows above each and columns to its left, `NO_RETURN` beyond the border."""
    height, width = image.shape[:2]
    sides = (COLUMNS_BESIDE, max(COLUMNS_BESIDE, LEANING_PX))
    rest = ((0, 0),) * (image.ndim - 2)
    wide = jnp.pad(image, ((ROWS_BEFORE, 0), sides, *rest), constant_values=NO_RETURN)
    wide = jax.lax.optimization_barrier(wide)  # else every use pads anew, pixel by pixel

    def at(down: int, across: int) -> jax.Array:
        row, column = ROWS_BEFORE - down, COLUMNS_BESIDE - across
        return wide[row : row + height, column : column + width]

    return at


def wide_slopes(
    depth_m: jax.Array, base: jax.Array, first: tuple[jax.Array, ...], sigma: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Slopes (H, W) in inverse depth of the plane through all pixels before that lie near a first one.

    Args:
        depth_m: (H, W).
        base: (H, W) inverse depth from which planes rise.
        first: (3) (H, W) what the first plane has here, and its slopes.
        sigma: (H, W) standard deviation of inverse depths.
    """
    size = depth_m.shape
    rows, columns = (min(WIDE_PX, length - 1) for length in size)
    wide = jnp.pad(depth_m, ((rows, 0), (columns, columns)), constant_values=NO_RETURN)
    down, across = np.divmod(np.arange((rows + 1) * (2 * columns + 1)), 2 * columns + 1)
    before = np.stack([down, columns - across], axis=1).astype(np.int32)
    places = jnp.asarray(before[(before[:, 0] > 0) | (before[:, 1] > 0)])

    def add(number: jax.Array, sums: Sums) -> Sums:
        down, across = places[number]
        near_m = jax.lax.dynamic_slice(wide, (rows - down, columns - across), size)
        measured = near_m != NO_RETURN
        value = 1 / jnp.where(measured, near_m, 1.0) - base
        away = value - (first[0] - across * first[1] - down * first[2])
        use = measured & (jnp.abs(away) < NEAR_SIGMAS * sigma)
        return with_pixel(sums, value, use.astype(depth_m.dtype), -across, -down)

    sums = jax.lax.fori_loop(0, len(places), add, (jnp.zeros_like(depth_m),) * 9)
    return solved_plane(sums, STIFFNESS, LEAST_COUNT)[1:]
