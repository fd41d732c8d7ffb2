"""What objects show in images, computed where they are and not elsewhere.

`PixelDensity.of_object` looks at every pixel of the image, of which most objects cover a small part. A factor
depends on few pixels round its own, so that tiles with a margin of these give the same numbers. Tiles of one
size serve objects of any: the density is compiled once. They are computed together: alone, starting each
operation would take longer than its pixels.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.execution import map_parallel
from scene.likelihood.causal_planes import COLUMNS_BESIDE, ROWS_BEFORE
from scene.likelihood.pixel_density import PixelDensity
from shapes.rendering.ray_casting import sort_chosen_first

BEYOND_PX = 2
"""Pixels to the right of and below an object that it still has a part in; to the left and above fewer."""
ROWS_ABOVE, ROWS_BELOW, COLUMNS_ASIDE = ROWS_BEFORE + 1, 1, COLUMNS_BESIDE + 1
"""The margin of a tile: planes through pixels before, which tell by the pixels beside them what they show."""
TILE = 28, 28
"""Rows and columns with their margins. Of (20, 24) to (44, 48) all take as long; objects are as wide."""
PIXELS_TOGETHER = 2**14
"""Of tiles that are computed together, so that they stay in a core's cache: speed."""

LAYERS = 64
"""Of a kernel; kernels run side by side, each on a core, and one size serves any number."""

Layers = tuple[jax.Array, jax.Array]


def layer_densities(
    density: PixelDensity, layers_m: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What `object_densities` gives for any number of layers (n, H, W) in one image."""

    def weighed(first: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        count = min(LAYERS, len(layers_m) - first)
        filled = np.full((LAYERS, *layers_m.shape[1:]), np.float32(np.inf))
        filled[:count] = layers_m[first : first + count]
        log_density, depth_m = jax.device_get(_layer_densities(density, filled))
        return log_density[:count], depth_m[:count]

    parts = map_parallel(weighed, range(0, len(layers_m), LAYERS))
    log_density, depth_m = (np.concatenate(leaves) for leaves in zip(*parts, strict=True))
    return log_density, depth_m


def compile_layer_densities(density: PixelDensity) -> None:
    """What `layer_densities` runs."""
    nothing = np.full((LAYERS, *density.log_rest.shape), np.float32(np.inf))
    _layer_densities.lower(density, nothing).compile()


@jax.jit
def _layer_densities(density: PixelDensity, layers_m: jax.Array) -> Layers:
    alike = jax.tree.map(lambda leaf: leaf[None], density)
    return object_densities(alike, layers_m, jnp.zeros(len(layers_m), jnp.int32))


def object_densities(density: PixelDensity, layers_m: jax.Array, frames: jax.Array) -> Layers:
    """What `PixelDensity.of_object` gives where depths are finite; elsewhere a log density of 0.

    Args:
        density: of F images, leaves (F, ...).
        layers_m: (n, H, W) depth of objects, each alone, +inf beside it.
        frames: (n,) int32 in which image each is seen.
    """
    size = layers_m.shape[1:]
    tile = min(TILE[0], size[0]), min(TILE[1], size[1])
    layer, row, column, number = _tiles(layers_m, _inside(tile, size))
    together = min(max(PIXELS_TOGETHER // (tile[0] * tile[1]), 1), len(layer))

    def some(turn: jax.Array, shown: Layers) -> Layers:
        place = turn * together + jnp.arange(together, dtype=jnp.int32)
        mine = [part[jnp.minimum(place, len(layer) - 1)] for part in (layer, row, column)]
        parts, starts, within = jax.vmap(partial(_of_tile, density, layers_m, frames, tile))(*mine)
        within &= (place < number)[:, None, None]

        def put(one: jax.Array, shown: Layers) -> Layers:
            start = mine[0][one], starts[0][one], starts[1][one]

            def with_part(whole: jax.Array, part: jax.Array) -> jax.Array:
                before = jax.lax.dynamic_slice(whole, start, (1, *tile))
                return jax.lax.dynamic_update_slice(
                    whole, jnp.where(within[one], part[one], before[0])[None], start
                )

            return jax.tree.map(with_part, shown, parts)

        return jax.lax.fori_loop(0, together, put, shown)

    nothing = jnp.zeros_like(layers_m), jnp.full_like(layers_m, jnp.inf)
    return jax.lax.fori_loop(0, -(-number // together), some, nothing)


def _inside(tile: tuple[int, int], size: tuple[int, ...]) -> tuple[int, int]:
    """Rows and columns of a tile without its margin; it needs none where it is as large as the image."""
    margins = ROWS_ABOVE + ROWS_BELOW, 2 * COLUMNS_ASIDE
    rows, columns = (
        part if part == whole else part - margin
        for part, whole, margin in zip(tile, size, margins, strict=True)
    )
    return rows, columns


def _tiles(layers_m: jax.Array, inside: tuple[int, int]) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Layer, first row and first column (T,) of tiles, whose insides hold all that objects have a part in.

    Those are the first ones; the last value tells how many.
    """
    covered = jnp.isfinite(layers_m)
    starts, taken = [], []
    for axis, length in enumerate(inside, 1):
        first, after = lines_around(jnp.any(covered, axis=3 - axis), BEYOND_PX)
        most = -(-layers_m.shape[axis] // length)
        start = first[:, None] + length * jnp.arange(most, dtype=jnp.int32)[None]
        starts.append(start)
        taken.append(start < after[:, None])
    rows, columns = starts
    order, number = sort_chosen_first((taken[0][:, :, None] & taken[1][:, None]).ravel())
    layer, which = jnp.divmod(order, rows.shape[1] * columns.shape[1])
    return layer, rows[layer, which // columns.shape[1]], columns[layer, which % columns.shape[1]], number


def lines_around(covered: jax.Array, beyond: int) -> tuple[jax.Array, jax.Array]:
    """First line (...) of what is covered (..., lines) and of so many beside it, and the line after the last.

    That is 0 where nothing is covered.
    """
    lines = covered.shape[-1]
    first = jnp.maximum(jnp.argmax(covered, axis=-1) - beyond, 0)
    after = jnp.minimum(lines - jnp.argmax(covered[..., ::-1], axis=-1) + beyond, lines)
    there = jnp.any(covered, axis=-1)
    return first.astype(jnp.int32), jnp.where(there, after, 0).astype(jnp.int32)


def _of_tile(
    density: PixelDensity,
    layers_m: jax.Array,
    frames: jax.Array,
    tile: tuple[int, int],
    which: jax.Array,
    row: jax.Array,
    column: jax.Array,
) -> tuple[Layers, tuple[jax.Array, jax.Array], jax.Array]:
    """Log density and depth of a layer in a tile, its first row and column, and what is inside its margin.

    Args:
        density: of all images.
        layers_m: (n, H, W).
        frames: (n,).
        tile: rows and columns.
        which: number of the layer.
        row: first one inside the margin.
        column: likewise.
    """
    size = layers_m.shape[1:]
    top = jnp.clip(row - ROWS_ABOVE, 0, size[0] - tile[0])
    left = jnp.clip(column - COLUMNS_ASIDE, 0, size[1] - tile[1])

    def cut(images: jax.Array, number: jax.Array) -> jax.Array:
        if images.ndim < 3:  # no images, but numbers
            return images[number]
        start = (number, *[jnp.int32(0)] * (images.ndim - 3), top, left)
        return jax.lax.dynamic_slice(images, start, (1, *images.shape[1:-2], *tile))[0]

    frame = frames[which]
    image = jax.tree.map(lambda leaf: cut(leaf, frame), density.image)
    sensor = replace(density, image=None, log_rest=None)
    mine = replace(jax.tree.map(lambda leaf: leaf[frame], sensor), image=image)
    log_density, depth_m = mine.of_object(cut(layers_m, which))
    log_density = jnp.where(jnp.isfinite(depth_m), log_density, 0.0)
    rows, columns = _inside(tile, size)
    below, beside = top + jnp.arange(tile[0]) - row, left + jnp.arange(tile[1]) - column
    within = ((below >= 0) & (below < rows))[:, None] & ((beside >= 0) & (beside < columns))[None]
    return (log_density.astype(layers_m.dtype), depth_m.astype(layers_m.dtype)), (top, left), within
