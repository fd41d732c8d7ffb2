"""Depth images of posed objects: one layer an object, so that moving one renders one."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from shapes.geometry.camera import Camera
from shapes.rendering.object_library import ObjectLibrary
from shapes.rendering.ray_casting import PosedObjects
from shapes.rendering.tile_queue import for_each_block
from shapes.rendering.tiles import TILE_PIXELS, from_tiles, tile_counts
from shapes.stored_kernels import jit_stored


@jit_stored(static_argnames=("height", "width"))
def render_layers(
    library: ObjectLibrary, posed: PosedObjects, cameras: Camera, height: int, width: int
) -> jax.Array:
    """Depth images (N, height, width) in metres of N objects, each alone; +inf where a ray meets nothing.

    One ray goes through every integer pixel centre, so there are no holes at any distance. Compiled once
    for a number of views, an image size and a size of the library's table.

    Args:
        library: the objects.
        posed: N posed objects.
        cameras: leaves (I,), pixel coordinates of the images.
        height: of the images.
        width: of the images.
    """
    rows = render_tiles(library, posed, cameras, height, width)
    return from_tiles(rows.reshape(-1, TILE_PIXELS), height, width)


def render_tiles(
    library: ObjectLibrary, posed: PosedObjects, cameras: Camera, height: int, width: int
) -> jax.Array:
    """The same images cut into tiles (N, tiles, TILE_PIXELS); beyond the border means nothing."""
    down, across = tile_counts(height, width)
    tiles = down * across
    rows = jnp.full((len(posed) * tiles, TILE_PIXELS), jnp.inf, jnp.float32)

    def write(
        rows: jax.Array, view: jax.Array, tile: jax.Array, depth: jax.Array, valid: jax.Array
    ) -> jax.Array:
        place = jnp.where(valid, view * tiles + tile, len(rows))
        return rows.at[place].set(depth, mode="drop")

    rows = for_each_block(library, posed, cameras, height, width, write, rows)
    return rows.reshape(len(posed), tiles, TILE_PIXELS)
