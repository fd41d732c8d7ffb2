"""The tiles that posed objects touch, gathered in blocks of one size whatever the poses.

Candidates are the tiles under each object's bounding box; those that its distance field proves empty are
dropped before any pixel is looked at, so that near and far objects share one compiled kernel and no work
is spent on empty tiles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from shapes.geometry.camera import Camera, project
from shapes.rendering.object_library import ObjectLibrary
from shapes.rendering.ray_casting import (
    NEAREST_M,
    PosedObjects,
    first_hits,
    free_depth,
    gather,
    image_rays,
    in_single_precision,
    sort_chosen_first,
    tile_rays,
)
from shapes.rendering.tiles import TILE, tile_counts

LEAST_BLOCK, LARGEST_BLOCK = 128, 4096
"""Tiles cast together: starting a kernel costs little beside them, and their pixels stay in the cache."""

TILES_OF_A_VIEW = 8
"""Where there are few views, blocks are smaller."""

Carry = TypeVar("Carry")

Visit = Callable[[Carry, jax.Array, jax.Array, jax.Array, jax.Array], Carry]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Candidates:
    """Rectangles of tiles, one a view, numbered through; `end` is the running sum of their areas."""

    first_row: jax.Array
    first_column: jax.Array
    columns: jax.Array
    end: jax.Array


def for_each_block(
    library: ObjectLibrary,
    posed: PosedObjects,
    cameras: Camera,
    height: int,
    width: int,
    visit: Visit,
    carry: Carry,
) -> Carry:
    """Fold `visit` over blocks of tiles that the posed objects may touch.

    Args:
        library: the objects.
        posed: N posed objects.
        cameras: leaves (I,).
        height: of the images in pixels.
        width: of the images in pixels.
        visit: (carry, view, tile, depth_m, valid) -> carry with view (B,) in 0..N-1, tile (B,) the row of
            pixels in a tiled image, depth_m (B, TILE_PIXELS) and valid (B,) False for padding.
        carry: its first value.
    """
    posed, cameras = in_single_precision(posed, cameras)
    images = image_rays(library, posed, cameras)
    candidates = _candidates(library, posed, cameras, height, width)
    total = candidates.end[-1]
    block = 1 << (len(posed) * TILES_OF_A_VIEW - 1).bit_length()
    block = min(max(block, LEAST_BLOCK), LARGEST_BLOCK)
    examined = 2 * block
    across = tile_counts(height, width)[1]

    def examine(state: tuple[jax.Array, Carry]) -> tuple[jax.Array, Carry]:
        following, carry = state
        view, row, column, known = _numbered(candidates, following + jnp.arange(examined, dtype=jnp.int32))
        rays = tile_rays(images, view, row, column)
        free = free_depth(library.table, rays)
        order, count = sort_chosen_first(known & jnp.isfinite(free))

        def cast(turn: jax.Array, carry: Carry) -> Carry:
            chosen = jax.lax.dynamic_slice_in_dim(order, turn * block, block)
            valid = turn * block + jnp.arange(block, dtype=jnp.int32) < count
            clear = jnp.where(valid, free[chosen], jnp.inf)
            depth = first_hits(library.table, gather(rays, chosen), clear)
            return visit(carry, view[chosen], (row * across + column)[chosen], depth, valid)

        return following + examined, jax.lax.fori_loop(0, -(-count // block), cast, carry)

    return jax.lax.while_loop(lambda state: state[0] < total, examine, (jnp.int32(0), carry))[1]


def _numbered(
    candidates: _Candidates, number: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """View, row and column of tiles by number, and whether they exist."""
    views = len(candidates.end)
    view = jnp.searchsorted(candidates.end, number, side="right").astype(jnp.int32)
    known = view < views
    view = jnp.minimum(view, views - 1)
    columns = jnp.maximum(candidates.columns[view], 1)
    local = number - jnp.where(view > 0, candidates.end[view - 1], 0)
    row = candidates.first_row[view] + local // columns
    return view, row, candidates.first_column[view] + local % columns, known


def _candidates(
    library: ObjectLibrary, posed: PosedObjects, cameras: Camera, height: int, width: int
) -> _Candidates:
    """The tiles under the projected bounding box of each posed object, cut at the image's border."""
    low, high, seen = pixel_bounds(library, posed, cameras)
    limit = jnp.array([[width - 1.0, height - 1.0]], jnp.float32)
    first = jnp.clip(jnp.ceil(low), 0.0, limit + 1)
    last = jnp.clip(jnp.floor(high), -1.0, limit)
    seen = seen & (first <= last).all(axis=1)
    first = (first / TILE).astype(jnp.int32)
    count = (last / TILE).astype(jnp.int32) - first + 1
    count = jnp.where(seen[:, None], count, 0)
    end = jnp.cumsum(count[:, 0] * count[:, 1], dtype=jnp.int32)
    return _Candidates(first[:, 1], first[:, 0], count[:, 0], end)


def pixel_bounds(
    library: ObjectLibrary, posed: PosedObjects, cameras: Camera
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Lowest and highest (u, v) (N, 2) under each object's bounding box, and whether it is seen (N,).

    Where the box reaches behind the camera the bounds are infinite.
    """
    posed, cameras = in_single_precision(posed, cameras)
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), np.float32).reshape(3, 8)
    model = posed.object_index
    corner = library.centre_m[model][:, :, None] + library.half_extent_m[model][:, :, None] * signs[None]
    if posed.scale is not None:
        corner = corner * posed.scale[:, :, None]
    pose = posed.camera_from_object
    x, y, z = (
        sum(pose[:, axis, b, None] * corner[:, b] for b in range(3)) + pose[:, axis, 3, None]
        for axis in range(3)
    )
    camera: Camera = jax.tree.map(lambda leaf: leaf[posed.camera_index][:, None], cameras)
    depth = jnp.maximum(z, NEAREST_M)
    u, v = project(camera, x, y, depth)
    near = (z < NEAREST_M).any(axis=1)[:, None]
    low = jnp.where(near, -jnp.inf, jnp.stack([u.min(axis=1), v.min(axis=1)], axis=1))
    high = jnp.where(near, jnp.inf, jnp.stack([u.max(axis=1), v.max(axis=1)], axis=1))
    finite = jnp.isfinite(pose).all(axis=(1, 2))
    return low, high, (z > NEAREST_M).any(axis=1) & finite
