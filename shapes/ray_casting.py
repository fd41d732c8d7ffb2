"""First intersections of pixel rays with posed objects, by stepping through their distance fields.

A ray is p(s) = start + s direction in the object's voxel coordinates, where s is depth relative to the
object's centre: small numbers, so that float32 loses nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from shapes.camera import Camera
from shapes.object_library import ObjectLibrary, unpacked
from shapes.tiles import TILE, TILE_PIXELS

ARRIVED = 0.12
"""Voxels from the surface at which the tangent plane's own intersection ends the march."""
STRETCH = 1.0
"""Longest step towards the tangent plane in distances to the surface; above 1 it may cross thin walls."""
MOST_STEPS = 100
CONE_STEPS = 16
CONE_SLACK = 0.3
"""Voxels by which a stored distance may overrate the true one."""
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
    """The rays of B tiles, linear in the pixel's place; leaves (B,).

    Attributes:
        start: of the tile's first pixel, in voxels.
        direction: of the tile's first pixel, in voxels per metre of depth.
        across: change of `direction` from one column to the next.
        down: the same from one row to the next.
        reference_m: depth at s = 0; `start` changes by this times `across` and `down`.
        speed: voxels per metre of depth, the largest in the tile.
        spread: voxels per metre of depth from the tile's central ray to its corner.
        size: voxels per axis, as floats.
        first_voxel: of the object in the table.
        nearest_m: least s, of the bounding sphere or just before the camera.
        furthest_m: greatest s, of the bounding sphere.
    """

    start: Vector
    direction: Vector
    across: Vector
    down: Vector
    reference_m: jax.Array
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
    pitch = library.pitch_m[model]
    centre = library.centre_m.T[:, model]
    origin = library.grid_origin_m.T[:, model]
    centre_camera = [_dot(rotation[axis], centre) + translation[axis] for axis in range(3)]
    radius = library.radius_m[model]
    reference = jnp.maximum(centre_camera[2], 0.05 * radius)
    # grid axis a of a camera vector c: sum_b rotation[b][a] c[b] / pitch
    to_grid = [[rotation[b][a] / pitch for b in range(3)] for a in range(3)]
    x = (column * TILE - camera.cx) / camera.fx
    y = (row * TILE - camera.cy) / camera.fy
    offset = (
        (x - centre_camera[0] / reference) * reference,
        (y - centre_camera[1] / reference) * reference,
        reference - centre_camera[2],
    )
    furthest = jnp.maximum(jnp.abs(x), jnp.abs(x + (TILE - 1) / camera.fx)) ** 2
    furthest += jnp.maximum(jnp.abs(y), jnp.abs(y + (TILE - 1) / camera.fy)) ** 2
    return TileRays(
        start=[_dot(to_grid[a], offset) + (centre[a] - origin[a]) / pitch for a in range(3)],
        direction=[_dot(to_grid[a], (x, y, jnp.ones_like(x))) for a in range(3)],
        across=[to_grid[a][0] / camera.fx for a in range(3)],
        down=[to_grid[a][1] / camera.fy for a in range(3)],
        reference_m=reference,
        speed=jnp.sqrt(1.0 + furthest) / pitch,
        spread=(TILE - 1) / 2 * jnp.sqrt(1 / camera.fx**2 + 1 / camera.fy**2) / pitch,
        size=[library.size[model, a].astype(jnp.float32) for a in range(3)],
        first_voxel=library.first_voxel[model],
        nearest_m=jnp.maximum(centre_camera[2] - radius, NEAREST_M) - reference,
        furthest_m=centre_camera[2] + radius - reference,
    )


def free_depth(table: jax.Array, rays: TileRays) -> jax.Array:
    """Depth s (B,) up to which the whole tile sees nothing; +inf where it sees nothing at all.

    Cone marching: the rays of a tile stay within `spread` times the depth of the central one.
    """
    half = (TILE - 1) / 2
    change = [half * (a + d) for a, d in zip(rays.across, rays.down, strict=True)]
    direction = _plus(rays.direction, change)
    start = _plus(rays.start, [rays.reference_m * c for c in change])

    def advance(_: jax.Array, s: jax.Array) -> jax.Array:
        point = [p + s * d for p, d in zip(start, direction, strict=True)]
        inside = [jnp.clip(p, 0.0, n - 0.5) for p, n in zip(point, rays.size, strict=True)]
        outside = [p - q for p, q in zip(point, inside, strict=True)]
        beyond = jnp.sqrt(_dot(outside, outside))
        distance, _ = _distance(table, rays.first_voxel, rays.size, inside)
        clearance = jnp.maximum(distance - beyond, beyond) - CONE_SLACK
        radius = (rays.reference_m + s) * rays.spread
        return s + jnp.maximum((clearance - radius) / (rays.speed + rays.spread), 0.0)

    s = jax.lax.fori_loop(0, CONE_STEPS, advance, rays.nearest_m)
    return jnp.where(s <= rays.furthest_m, s, jnp.inf)


def cast(table: jax.Array, rays: TileRays, free: jax.Array) -> jax.Array:
    """Depth in metres (B, TILE_PIXELS) where each pixel's ray meets the object, +inf where it does not.

    Args:
        table: of the library.
        rays: of B tiles.
        free: (B,) depth s from which to march, as `free_depth` gives it.
    """
    rays = jax.tree.map(lambda leaf: leaf[:, None], rays)
    column = np.arange(TILE_PIXELS, dtype=np.float32)[None] % TILE
    row = np.arange(TILE_PIXELS, dtype=np.float32)[None] // TILE
    change = [column * a + row * d for a, d in zip(rays.across, rays.down, strict=True)]
    direction = _plus(rays.direction, change)
    start = _plus(rays.start, [rays.reference_m * c for c in change])
    enter, leave = _crossing(start, direction, rays.size)
    leave = jnp.minimum(leave, rays.furthest_m)

    def advance(carry: tuple) -> tuple:
        count, s, arrived = carry
        point = [p + s * d for p, d in zip(start, direction, strict=True)]
        distance, normal = _distance(table, rays.first_voxel, rays.size, point)
        approach = -_dot(normal, direction)
        here = distance < ARRIVED
        towards = jnp.where(approach > 0, jnp.maximum(approach, rays.speed / STRETCH), rays.speed)
        steep = jnp.where(
            jnp.abs(approach) < 0.2 * rays.speed, jnp.copysign(0.2 * rays.speed, approach), approach
        )
        step = distance / jnp.where(here, steep, towards)
        return count + 1, jnp.where(arrived, s, s + step), arrived | here

    def marching(carry: tuple) -> jax.Array:
        count, s, arrived = carry
        return (count < MOST_STEPS) & (~arrived & (s <= leave)).any()

    first = jnp.maximum(free[:, None], enter)
    _, s, arrived = jax.lax.while_loop(marching, advance, (jnp.int32(0), first, jnp.zeros(first.shape, bool)))
    hit = arrived & (s <= leave) & jnp.isfinite(s)
    return jnp.where(hit, rays.reference_m + s, jnp.inf)


def _distance(
    table: jax.Array, first_voxel: jax.Array, size: Vector, point: Vector
) -> tuple[jax.Array, Vector]:
    """Signed distance of a point in voxels by the tangent plane of its voxel, and that plane's normal."""
    i, j, k = (jnp.floor(jnp.clip(p, 0.0, n - 0.5)) for p, n in zip(point, size, strict=True))
    index = first_voxel + ((i * size[1] + j) * size[2] + k).astype(jnp.int32)
    distance, *normal = unpacked(table.at[index].get(mode="clip"))
    offset = [p - 0.5 - c for p, c in zip(point, (i, j, k), strict=True)]
    return distance + _dot(normal, offset), normal


def _crossing(start: Vector, direction: Vector, size: Vector) -> tuple[jax.Array, jax.Array]:
    """Depths s at which rays enter and leave the grid; enter > leave for those that pass it by."""
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


def signed_distance_m(library: ObjectLibrary, object_index: jax.Array, points_m: Vector) -> jax.Array:
    """Signed distance of points to one object's surface in metres, positive outside.

    Exact to a fraction of a voxel near the surface; outside the grid, that of the nearest voxel plus the
    way to it.

    Args:
        library: the objects.
        object_index: () which object.
        points_m: x, y, z in the object's frame, each (...).
    """
    pitch, origin = library.pitch_m[object_index], library.grid_origin_m[object_index]
    size = library.size[object_index].astype(jnp.float32)
    point = [(p - o) / pitch for p, o in zip(points_m, origin, strict=True)]
    inside = [jnp.clip(p, 0.0, n - 0.5) for p, n in zip(point, size, strict=True)]
    outside = [p - q for p, q in zip(point, inside, strict=True)]
    distance, _ = _distance(library.table, library.first_voxel[object_index], size, inside)
    return (distance + jnp.sqrt(_dot(outside, outside))) * pitch
