"""What objects show in images, each computed where it is and not elsewhere.

`PixelDensity.of_object` looks at every pixel of the image, of which most objects cover a small part. A crop
that holds the object and the pixels on which its factors depend gives the same numbers. Crops of one size are
computed together: alone, starting each operation would take longer than its pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.execution import map_parallel
from scene.likelihood.pixel_density import PixelDensity
from shapes.rendering.ray_casting import sort_chosen_first

CROPS = (28, 28), (40, 40), (56, 64), (84, 112)
"""Pixels of crops, each twice as many as of the one before; what fits none is not cut."""
MARGIN_PX = 5
"""The factors of pixels up to two beside an object look at pixels up to three further on."""
PIXELS_TOGETHER = 2**14
"""Of crops that are computed together, so that they stay in a core's cache: speed."""

LAYERS = 64
"""Of a kernel; kernels run side by side, each on a core, and one size serves any number."""

Layers = tuple[jax.Array, jax.Array]


Seen = Callable[[jax.Array, jax.Array, jax.Array, jax.Array, PixelDensity], jax.Array]
"""Log factor (h, w) in a crop: number of a layer, first row and column, the layer and the density there."""


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


def object_densities(
    density: PixelDensity, layers_m: jax.Array, frames: jax.Array, beside: Seen | None = None
) -> Layers:
    """What `PixelDensity.of_object` gives where depths are finite; elsewhere a log density of 0.

    Args:
        density: of F images, leaves (F, ...).
        layers_m: (n, H, W) depth of objects, each alone, +inf beside it.
        frames: (n,) int32 in which image each is seen.
        beside: what else tells of the pixels that an object covers; None for nothing.
    """
    count, height, width = layers_m.shape
    covered = jnp.isfinite(layers_m)
    (top, down), (left, across) = (_bounds(jnp.any(covered, axis=axis)) for axis in (2, 1))
    sizes = [crop for crop in CROPS if crop[0] < height and crop[1] < width]
    way = jnp.zeros(count, jnp.int32)
    for rows, columns in sizes:
        way += (down > rows) | (across > columns)
    way = jnp.where(down > 0, way, len(sizes) + 1)
    shape = count + 1, height, width
    shown = jnp.zeros(shape, layers_m.dtype), jnp.full(shape, jnp.inf, layers_m.dtype)
    for number, (rows, columns) in enumerate([*sizes, (height, width)]):
        order, mine = sort_chosen_first(way == number)
        starts = jnp.minimum(top, height - rows), jnp.minimum(left, width - columns)
        places = order, starts[0][order], starts[1][order]
        shown = _of_size(density, layers_m, frames, beside, places, mine, (rows, columns), shown)
    return shown[0][:-1], shown[1][:-1]


def _bounds(covered: jax.Array) -> tuple[jax.Array, jax.Array]:
    """First line (n,) of crops that hold all that is covered (n, lines), and how many lines they need."""
    lines = covered.shape[1]
    first = jnp.maximum(jnp.argmax(covered, axis=1) - MARGIN_PX, 0)
    after = jnp.minimum(lines - jnp.argmax(covered[:, ::-1], axis=1) + MARGIN_PX, lines)
    return first, jnp.where(jnp.any(covered, axis=1), after - first, 0)


def _of_size(
    density: PixelDensity,
    layers_m: jax.Array,
    frames: jax.Array,
    beside: Seen | None,
    places: tuple[jax.Array, jax.Array, jax.Array],
    count: jax.Array,
    crop: tuple[int, int],
    shown: Layers,
) -> Layers:
    """`shown` with what the first `count` of the layers at `places` show, in crops of one size.

    Args:
        density: of all images.
        layers_m: (n, H, W).
        frames: (n,).
        beside: as `object_densities` has it.
        places: number of a layer, first row and first column of its crop, (n,) each.
        count: of layers whose crops have this size.
        crop: rows and columns.
        shown: log density and depth (n + 1, H, W); the last are written where there is no layer.
    """
    together = min(max(PIXELS_TOGETHER // (crop[0] * crop[1]), 1), len(frames))

    def one(which: jax.Array, row: jax.Array, column: jax.Array) -> Layers:
        def cut(images: jax.Array, number: jax.Array) -> jax.Array:
            if images.ndim < 3:  # no images, but numbers
                return images[number]
            start = (number, *[jnp.int32(0)] * (images.ndim - 3), row, column)
            return jax.lax.dynamic_slice(images, start, (1, *images.shape[1:-2], *crop))[0]

        frame = frames[which]
        image = jax.tree.map(lambda leaf: cut(leaf, frame), density.image)
        sensor = replace(density, image=None, log_rest=None)
        mine = replace(jax.tree.map(lambda leaf: leaf[frame], sensor), image=image)
        layer_m = cut(layers_m, which)
        log_density, depth_m = mine.of_object(layer_m)
        if beside is not None:
            log_density += jnp.where(jnp.isfinite(layer_m), beside(which, row, column, layer_m, mine), 0.0)
        log_density = jnp.where(jnp.isfinite(depth_m), log_density, 0.0)
        return log_density.astype(layers_m.dtype), depth_m.astype(layers_m.dtype)

    def some(turn: jax.Array, shown: Layers) -> Layers:
        number = turn * together + jnp.arange(together, dtype=jnp.int32)
        taken = jnp.minimum(number, len(frames) - 1)
        which, rows, columns = (part[taken].astype(jnp.int32) for part in places)
        parts = jax.vmap(one)(which, rows, columns)
        target = jnp.where(number < count, which, len(frames))
        for place in range(together):
            start = target[place], rows[place], columns[place]
            shown = jax.tree.map(
                lambda whole, part, start=start, place=place: jax.lax.dynamic_update_slice(
                    whole, part[place][None], start
                ),
                shown,
                parts,
            )
        return shown

    return jax.lax.fori_loop(0, -(-count // together), some, shown)
