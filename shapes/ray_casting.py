"""First intersections of pixel rays with posed objects, by stepping through their distance fields.

A ray is p(z) = origin + z direction in the object's voxel coordinates, where z is depth in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp

from shapes.camera import Camera
from shapes.object_library import LEVELS, ObjectLibrary, level_of, unpacked
from shapes.tiles import TILE, TILE_PIXELS

ARRIVED = 0.15
"""Voxels from the surface at which a ray has met it."""
NEAR = 1.0
"""Voxels from the surface from which a ray steps onto the tangent plane."""
SHALLOW = 0.7
"""Least cosine to the normal with which such a step reckons: no further than 1 / SHALLOW distances."""
LONGEST = 1.5
"""Longest step in distances to the surface; above 1 it may cross thin walls."""
STEPS = (6, 10, 12)
"""After each of these the rays that are not done go on by themselves."""
SHRINKING = 8
"""How many times fewer rays go on together."""
CONE_STEPS = 8
CONE_SLACK = 0.3
"""Voxels by which a stored distance may overrate the true one."""
VOXELS_PER_PIXEL = 2.0
"""The chosen level of detail has so many voxels along a pixel's edge or more, where the object is nearest."""
NEAREST_M = 1e-3
"""What is nearer to the camera than this is not seen."""

Vector = Any
"""Components x, y, z: a list of three arrays, or an array whose first axis has length 3."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PosedObjects:
    """N hypotheses, each one object in front of one of I cameras.

    Attributes:
        object_index: (N,) int32 in the library.
        camera_from_object: (N, 4, 4) rigid.
        camera_index: (N,) int32 among the cameras, and so among their images.
    """

    object_index: jax.Array
    camera_from_object: jax.Array
    camera_index: jax.Array

    def __len__(self) -> int:
        return len(self.object_index)


def in_single_precision(posed: PosedObjects, cameras: Camera) -> tuple[PosedObjects, Camera]:
    """The same in int32 and float32, as kernels want them, whatever precision chains run in."""
    posed = PosedObjects(
        jnp.asarray(posed.object_index, jnp.int32),
        jnp.asarray(posed.camera_from_object, jnp.float32),
        jnp.asarray(posed.camera_index, jnp.int32),
    )
    return posed, jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cameras)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TileRays:
    """The rays of B tiles, p(z) = origin + z direction; leaves (B,), or broadcasting against each other.

    Attributes:
        origin: the camera's centre, in voxels.
        direction: of the tile's first pixel, in voxels per metre of depth.
        across: change of `direction` from one column to the next.
        down: the same from one row to the next.
        speed: voxels per metre of depth, the largest in the tile.
        spread: voxels per metre of depth from the tile's central ray to its corner.
        size: voxels per axis, as floats.
        first_voxel: of the object in the table.
        nearest_m: least depth, of the bounding sphere or just before the camera.
        furthest_m: greatest depth, of the bounding sphere.
    """

    origin: Vector
    direction: Vector
    across: Vector
    down: Vector
    speed: jax.Array
    spread: jax.Array
    size: Vector
    first_voxel: jax.Array
    nearest_m: jax.Array
    furthest_m: jax.Array


def tile_rays(
    library: ObjectLibrary,
    posed: PosedObjects,
    cameras: Camera,
    view: jax.Array,
    row: jax.Array,
    column: jax.Array,
) -> TileRays:
    """Rays of tiles (B,): `view` indexes the posed objects, `row` and `column` count tiles."""
    model = posed.object_index[view]
    pose = posed.camera_from_object[view].reshape(-1, 16).T
    rotation, translation = [pose[4 * r : 4 * r + 3] for r in range(3)], pose[3:12:4]
    camera = jax.tree.map(lambda leaf: leaf[posed.camera_index[view]], cameras)
    centre = library.centre_m.T[:, model]
    origin = library.grid_origin_m.T[:, model]
    depth_of_centre = _dot(rotation[2], centre) + translation[2]
    radius = library.radius_m[model]
    pixel = jnp.maximum(depth_of_centre - radius, 0.05 * radius) / jnp.maximum(camera.fx, camera.fy)
    level = _level_of_detail(library.pitch_m[model], pixel)
    pitch, size, first_voxel = level_of(library, model, level)
    inverse = 1.0 / pitch
    # grid axis a of a camera vector c: sum_b rotation[b][a] c[b] / pitch
    to_grid = [[rotation[b][a] * inverse for b in range(3)] for a in range(3)]
    x = (column * TILE - camera.cx) / camera.fx
    y = (row * TILE - camera.cy) / camera.fy
    furthest = jnp.maximum(jnp.abs(x), jnp.abs(x + (TILE - 1) / camera.fx)) ** 2
    furthest += jnp.maximum(jnp.abs(y), jnp.abs(y + (TILE - 1) / camera.fy)) ** 2
    return TileRays(
        origin=[-_dot(to_grid[a], translation) - origin[a] * inverse for a in range(3)],
        direction=[_dot(to_grid[a], (x, y, jnp.ones_like(x))) for a in range(3)],
        across=[to_grid[a][0] / camera.fx for a in range(3)],
        down=[to_grid[a][1] / camera.fy for a in range(3)],
        speed=jnp.sqrt(1.0 + furthest) * inverse,
        spread=(TILE - 1) / 2 * jnp.sqrt(1 / camera.fx**2 + 1 / camera.fy**2) * inverse,
        size=[axis.astype(jnp.float32) for axis in size],
        first_voxel=first_voxel,
        nearest_m=jnp.maximum(depth_of_centre - radius, NEAREST_M),
        furthest_m=depth_of_centre + radius,
    )


def _level_of_detail(pitch_m: jax.Array, pixel_m: jax.Array) -> jax.Array:
    """The coarsest level (B,) that pixels of this size allow, for objects with this finest pitch."""
    coarser = [pixel_m >= VOXELS_PER_PIXEL * 2**level * pitch_m for level in range(1, LEVELS)]
    return jnp.stack(coarser).sum(axis=0, dtype=jnp.int32)


def free_depth(table: jax.Array, rays: TileRays) -> jax.Array:
    """Depth (B,) up to which the whole tile sees nothing; +inf where it sees nothing at all.

    Cone marching: the rays of a tile stay within `spread` times the depth of the central one.
    """
    half = (TILE - 1) / 2
    direction = _direction(rays, half, half)
    pace = 1.0 / (rays.speed + rays.spread)

    def advance(_: jax.Array, depth: jax.Array) -> jax.Array:
        point = [p + depth * d for p, d in zip(rays.origin, direction, strict=True)]
        inside = [jnp.clip(p, 0.0, n - 0.5) for p, n in zip(point, rays.size, strict=True)]
        outside = [p - q for p, q in zip(point, inside, strict=True)]
        beyond = jnp.sqrt(_dot(outside, outside))
        distance, _ = _distance(table, rays.first_voxel, rays.size, inside)
        clearance = jnp.maximum(distance - beyond, beyond) - CONE_SLACK
        return depth + jnp.maximum((clearance - depth * rays.spread) * pace, 0.0)

    depth = jax.lax.fori_loop(0, CONE_STEPS, advance, rays.nearest_m)
    return jnp.where(depth <= rays.furthest_m, depth, jnp.inf)


def first_hits(table: jax.Array, tiles: TileRays, free: jax.Array) -> jax.Array:
    """Depth in metres (B, TILE_PIXELS) where each ray first meets the surface, +inf where it meets none.

    A few rays graze the surface and need many steps: they go on by themselves, without the others.

    Args:
        table: of the library.
        tiles: rays of B tiles.
        free: (B,) of `free_depth`; +inf where nothing shall be looked for.
    """
    number = jnp.arange(TILE_PIXELS, dtype=jnp.int32)[None]
    rays = jax.tree.map(lambda leaf: leaf[:, None], tiles)
    depth, met, left = _advanced(table, rays, number, free[:, None], STEPS[0])
    pixel = jnp.arange(depth.size, dtype=jnp.int32)
    depth, met, left = depth.reshape(-1), met.reshape(-1), left.reshape(-1)
    hits = jnp.where(met, depth, jnp.inf)
    return _continued(table, tiles, pixel, depth, ~(met | left), hits, STEPS[1:]).reshape(-1, TILE_PIXELS)


def _continued(
    table: jax.Array,
    tiles: TileRays,
    pixel: jax.Array,
    depth: jax.Array,
    undone: jax.Array,
    hits: jax.Array,
    steps: tuple[int, ...],
) -> jax.Array:
    """The hits (B * TILE_PIXELS,) with those of rays (P,), now at `depth`, that are not done."""
    if not steps:
        return hits
    order, count = chosen_first(undone)
    together = len(pixel) // SHRINKING

    def march(turn: jax.Array, hits: jax.Array) -> jax.Array:
        mine = jax.lax.dynamic_slice_in_dim(order, turn * together, together)
        there = turn * together + jnp.arange(together, dtype=jnp.int32) < count
        where = pixel[mine]
        rays = jax.tree.map(itemgetter(where // TILE_PIXELS), tiles)
        reached = jnp.where(there, depth[mine], jnp.inf)
        reached, met, left = _advanced(table, rays, where % TILE_PIXELS, reached, steps[0])
        hits = hits.at[jnp.where(met, where, len(hits))].set(reached, mode="drop", unique_indices=True)
        return _continued(table, tiles, where, reached, ~(met | left), hits, steps[1:])

    return jax.lax.fori_loop(0, -(-count // together), march, hits)


def chosen_first(chosen: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Indices (N,) of which the first are those of the chosen (N,), in order, and the number of these."""
    place = jnp.cumsum(chosen, dtype=jnp.int32)
    number = jnp.arange(len(chosen), dtype=jnp.int32)
    target = jnp.where(chosen, place - 1, len(chosen))
    order = jnp.zeros_like(number).at[target].set(number, mode="drop", unique_indices=True)
    return order, place[-1]


def _advanced(
    table: jax.Array, rays: TileRays, number: jax.Array, depth: jax.Array, steps: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Depths of pixels `number` of tiles after so many steps, who meets the surface there and who has left.

    Sphere tracing with longer steps (Keinert et al. 2014, Enhanced Sphere Tracing): towards a plane at
    an angle with cosine a, the empty balls round both ends of a step of 2 / (1 + a) distances just touch.
    Close to the surface the tangent plane is met itself; a ray that has met it stays there.
    """
    column, row = number % TILE, number // TILE
    direction = _direction(rays, column.astype(jnp.float32), row.astype(jnp.float32))
    enter, leave = _crossing(rays.origin, direction, rays.size)
    leave = jnp.minimum(leave, rays.furthest_m)
    voxel_m = 1.0 / rays.speed

    def word_at(depth: jax.Array) -> jax.Array:
        point = [p + depth * d for p, d in zip(rays.origin, direction, strict=True)]
        return _word(table, rays.first_voxel, rays.size, point)

    def look(depth: jax.Array, word: jax.Array) -> tuple[jax.Array, jax.Array]:
        point = [p + depth * d for p, d in zip(rays.origin, direction, strict=True)]
        distance, normal = _plane_distance(word, rays.size, point)
        approach = -_dot(normal, direction) * voxel_m
        onto = distance / jnp.maximum(approach, SHALLOW)
        along = distance * jnp.clip(2.0 / jnp.maximum(1.0 + approach, 1e-3), 1.0, LONGEST)
        step = jnp.where(distance < NEAR, onto, along)
        return distance, jnp.where(depth > leave, depth, depth + step * voxel_m)

    def advance(_: jax.Array, march: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        _, depth = look(*march)
        return depth, word_at(depth)

    depth = jnp.maximum(depth, enter)
    depth, word = jax.lax.fori_loop(0, steps - 1, advance, (depth, word_at(depth)))
    distance, further = look(depth, word)
    left = ~(depth <= leave)
    return further, ~left & (distance < ARRIVED), left


def _direction(rays: TileRays, column: Any, row: Any) -> Vector:
    """Of the pixels at this column and row of the tile."""
    return [d + column * a + row * b for d, a, b in zip(rays.direction, rays.across, rays.down, strict=True)]


def _distance(
    table: jax.Array, first_voxel: jax.Array, size: Vector, point: Vector
) -> tuple[jax.Array, Vector]:
    """Signed distance of a point in voxels by the tangent plane of its voxel, and that plane's normal."""
    return _plane_distance(_word(table, first_voxel, size, point), size, point)


def _word(table: jax.Array, first_voxel: jax.Array, size: Vector, point: Vector) -> jax.Array:
    """The packed voxel that holds a point, or the nearest one."""
    i, j, k = _voxel(size, point)
    index = first_voxel + ((i * size[1] + j) * size[2] + k).astype(jnp.int32)
    return table.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _plane_distance(word: jax.Array, size: Vector, point: Vector) -> tuple[jax.Array, Vector]:
    distance, *normal = unpacked(word)
    offset = [p - 0.5 - c for p, c in zip(point, _voxel(size, point), strict=True)]
    return distance + _dot(normal, offset), normal


def _voxel(size: Vector, point: Vector) -> Vector:
    return [jnp.floor(jnp.clip(p, 0.0, n - 0.5)) for p, n in zip(point, size, strict=True)]


def _crossing(start: Vector, direction: Vector, size: Vector) -> tuple[jax.Array, jax.Array]:
    """Depths at which rays enter and leave the grid; enter > leave for those that pass it by."""
    enter, leave = [], []
    for p, d, n in zip(start, direction, size, strict=True):
        inverse = 1.0 / jnp.where(jnp.abs(d) < 1e-9, 1e-9, d)
        low, high = -p * inverse, (n - p) * inverse
        enter.append(jnp.minimum(low, high))
        leave.append(jnp.maximum(low, high))
    return jnp.maximum(jnp.maximum(*enter[:2]), enter[2]), jnp.minimum(jnp.minimum(*leave[:2]), leave[2])


def _plus(a: Vector, b: Vector) -> Vector:
    return [p + q for p, q in zip(a, b, strict=True)]


def _dot(a: Vector, b: Vector) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
