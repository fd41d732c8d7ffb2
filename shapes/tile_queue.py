"""The tiles that posed objects touch, gathered in blocks of one size whatever the poses.

Candidates are the tiles under each object's bounding box; those that its distance field proves empty are
dropped before any pixel is looked at, so that near and far objects share one compiled kernel and no work
is spent on empty tiles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from shapes.camera import Camera
from shapes.object_library import ObjectLibrary
from shapes.ray_casting import (
    MOST_STEPS,
    NEAREST_M,
    STEPS,
    PosedObjects,
    TileRays,
    advanced,
    begun,
    free_depth,
    in_single_precision,
    tile_rays,
)
from shapes.tiles import TILE, TILE_PIXELS, tile_counts

BLOCK = 1024
"""Tiles cast together: their pixels stay in the second-level cache."""
CANDIDATES = 2048
"""Tiles examined together."""

Carry = TypeVar("Carry")
Visit = Callable[[Carry, jax.Array, jax.Array, jax.Array, jax.Array], Carry]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Stack:
    """Tiles whose rays are on their way: the first `count` entries of each array.

    A turn takes the uppermost `BLOCK` tiles a few steps further and puts those that are not over back, so
    that one ray with many steps holds up its own tile alone.
    """

    count: jax.Array
    view: jax.Array
    tile: jax.Array
    steps: jax.Array
    depth: jax.Array
    rays: TileRays


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Finished:
    """Tiles whose depth is known and not yet looked at: the first `count` entries of each array."""

    count: jax.Array
    view: jax.Array
    tile: jax.Array
    depth: jax.Array


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
    candidates = _candidates(library, posed, cameras, height, width)
    total = candidates.end[-1]
    across = tile_counts(height, width)[1]

    def fill(state: tuple) -> tuple:
        following, stack = state
        return following + CANDIDATES, _appended(
            library, posed, cameras, candidates, across, following, stack
        )

    def look(state: tuple) -> tuple:
        finished, carry = state
        start = jnp.maximum(finished.count - BLOCK, 0)
        view, tile, depth = (
            jax.lax.dynamic_slice_in_dim(array, start, BLOCK)
            for array in (finished.view, finished.tile, finished.depth)
        )
        valid = jnp.arange(BLOCK, dtype=jnp.int32) < finished.count
        return replace(finished, count=start), visit(carry, view, tile, depth, valid)

    def turn(state: tuple) -> tuple:
        following, stack, finished, carry = state
        hungry = (following < total) & (stack.count < BLOCK)
        following, stack = jax.lax.cond(hungry, fill, lambda state: state, (following, stack))
        stack, finished = _marched(library.table, stack, finished)
        ended = (following >= total) & (stack.count == 0)
        ready = (finished.count >= BLOCK) | ended
        finished, carry = jax.lax.cond(ready, look, lambda state: state, (finished, carry))
        return following, stack, finished, carry

    def going(state: tuple) -> jax.Array:
        following, stack, finished, _ = state
        return (following < total) | (stack.count > 0) | (finished.count > 0)

    return jax.lax.while_loop(going, turn, (jnp.int32(0), _no_stack(), _none_finished(), carry))[3]


def _no_stack() -> _Stack:
    none = jnp.zeros(BLOCK + CANDIDATES, jnp.int32)
    rows = jnp.zeros((BLOCK + CANDIDATES, TILE_PIXELS), jnp.float32)
    one = none.astype(jnp.float32)
    rays = TileRays([one] * 3, [one] * 3, [one] * 3, [one] * 3, one, one, one, [one] * 3, none, one, one)
    return _Stack(jnp.int32(0), none, none, none, rows, rays)


def _none_finished() -> _Finished:
    none = jnp.zeros(2 * BLOCK, jnp.int32)
    return _Finished(jnp.int32(0), none, none, jnp.zeros((2 * BLOCK, TILE_PIXELS), jnp.float32))


def _marched(table: jax.Array, stack: _Stack, finished: _Finished) -> tuple[_Stack, _Finished]:
    """The uppermost tiles some steps further; those that are over have moved to the finished."""
    start = jnp.maximum(stack.count - BLOCK, 0)
    arrays = (stack.view, stack.tile, stack.steps, stack.depth, stack.rays)
    view, tile, steps, depth, rays = jax.tree.map(
        lambda array: jax.lax.dynamic_slice_in_dim(array, start, BLOCK), arrays
    )
    depth, met, done = advanced(table, rays, depth)
    steps = steps + STEPS
    there = jnp.arange(BLOCK, dtype=jnp.int32) < stack.count
    over = there & (done.all(axis=1) | (steps >= MOST_STEPS))
    known = _pushed(finished.count, over, (finished.view, finished.tile, finished.depth), (view, tile, met))
    left = _pushed(start, there & ~over, arrays, (view, tile, steps, depth, rays))
    return _Stack(*left), _Finished(*known)


def _pushed(count: jax.Array, chosen: jax.Array, arrays: tuple, values: tuple) -> tuple:
    """The new count and the arrays with the chosen rows of the values after their first `count` rows."""
    place = count + jnp.cumsum(chosen, dtype=jnp.int32) - 1
    place = jnp.where(chosen, place, jnp.iinfo(jnp.int32).max)

    def put(array: jax.Array, value: jax.Array) -> jax.Array:
        return array.at[place].set(value, mode="drop", unique_indices=True)

    return count + chosen.sum(dtype=jnp.int32), *jax.tree.map(put, arrays, values)


def _appended(
    library: ObjectLibrary,
    posed: PosedObjects,
    cameras: Camera,
    candidates: _Candidates,
    across: int,
    following: jax.Array,
    stack: _Stack,
) -> _Stack:
    """The stack with those of the next candidates that the distance field does not prove empty."""
    number = following + jnp.arange(CANDIDATES, dtype=jnp.int32)
    view = jnp.searchsorted(candidates.end, number, side="right").astype(jnp.int32)
    known = view < len(posed)
    view = jnp.minimum(view, len(posed) - 1)
    columns = jnp.maximum(candidates.columns[view], 1)
    local = number - jnp.where(view > 0, candidates.end[view - 1], 0)
    row = candidates.first_row[view] + local // columns
    column = candidates.first_column[view] + local % columns
    rays = tile_rays(library, posed, cameras, view, row, column)
    free = free_depth(library.table, rays)
    pushed = _pushed(
        stack.count,
        known & jnp.isfinite(free),
        (stack.view, stack.tile, stack.steps, stack.depth, stack.rays),
        (view, row * across + column, jnp.zeros_like(view), begun(rays, free), rays),
    )
    return _Stack(*pushed)


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
    pose = posed.camera_from_object
    x, y, z = (
        sum(pose[:, axis, b, None] * corner[:, b] for b in range(3)) + pose[:, axis, 3, None]
        for axis in range(3)
    )
    camera: Camera = jax.tree.map(lambda leaf: leaf[posed.camera_index][:, None], cameras)
    depth = jnp.maximum(z, NEAREST_M)
    u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    near = (z < NEAREST_M).any(axis=1)[:, None]
    low = jnp.where(near, -jnp.inf, jnp.stack([u.min(axis=1), v.min(axis=1)], axis=1))
    high = jnp.where(near, jnp.inf, jnp.stack([u.max(axis=1), v.max(axis=1)], axis=1))
    finite = jnp.isfinite(pose).all(axis=(1, 2))
    return low, high, (z > NEAREST_M).any(axis=1) & finite
