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
STEPS = 6
"""Steps between two looks at which tiles are done."""
MOST_STEPS = 48
CONE_STEPS = 16
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
    centre = library.centre_m.T[:, model]
    origin = library.grid_origin_m.T[:, model]
    centre_camera = [_dot(rotation[axis], centre) + translation[axis] for axis in range(3)]
    radius = library.radius_m[model]
    reference = jnp.maximum(centre_camera[2], 0.05 * radius)
    pixel = jnp.maximum(centre_camera[2] - radius, 0.05 * radius) / jnp.maximum(camera.fx, camera.fy)
    level = _level_of_detail(library.pitch_m[model], pixel)
    pitch, size, first_voxel = level_of(library, model, level)
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
        size=[axis.astype(jnp.float32) for axis in size],
        first_voxel=first_voxel,
        nearest_m=jnp.maximum(centre_camera[2] - radius, NEAREST_M) - reference,
        furthest_m=centre_camera[2] + radius - reference,
    )


def _level_of_detail(pitch_m: jax.Array, pixel_m: jax.Array) -> jax.Array:
    """The coarsest level (B,) that pixels of this size allow, for objects with this finest pitch."""
    coarser = [pixel_m >= VOXELS_PER_PIXEL * 2**level * pitch_m for level in range(1, LEVELS)]
    return jnp.stack(coarser).sum(axis=0, dtype=jnp.int32)


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


def begun(rays: TileRays, free: jax.Array) -> jax.Array:
    """Depths s (B, TILE_PIXELS) where rays enter the grid, but not before `free` (B,) of `free_depth`."""
    rays = jax.tree.map(lambda leaf: leaf[:, None], rays)
    enter, _ = _crossing(*_of_pixels(rays), rays.size)
    return jnp.maximum(free[:, None], enter)


def advanced(table: jax.Array, rays: TileRays, depth: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Depths s (B, TILE_PIXELS) after `STEPS` further steps, what the rays met there, and who is done.

    Sphere tracing with longer steps (Keinert et al. 2014, Enhanced Sphere Tracing): towards a plane at
    an angle with cosine a, the empty balls round both ends of a step of 2 / (1 + a) distances just touch.
    Close to the surface the tangent plane is met itself; a ray that has met it stays there.

    Returns:
        Depths s; depth in metres where a ray has met the surface, +inf elsewhere; and the rays, as bools,
        that have met it or left it behind.
    """
    rays = jax.tree.map(lambda leaf: leaf[:, None], rays)
    start, direction = _of_pixels(rays)
    leave = jnp.minimum(_crossing(start, direction, rays.size)[1], rays.furthest_m)
    voxel_m = 1.0 / rays.speed

    def word_at(depth: jax.Array) -> jax.Array:
        point = [p + depth * d for p, d in zip(start, direction, strict=True)]
        return _word(table, rays.first_voxel, rays.size, point)

    def look(depth: jax.Array, word: jax.Array) -> tuple[jax.Array, jax.Array]:
        point = [p + depth * d for p, d in zip(start, direction, strict=True)]
        distance, normal = _plane_distance(word, rays.size, point)
        approach = -_dot(normal, direction) * voxel_m
        onto = distance / jnp.maximum(approach, SHALLOW)
        along = distance * jnp.clip(2.0 / jnp.maximum(1.0 + approach, 1e-3), 1.0, LONGEST)
        step = jnp.where(distance < NEAR, onto, along)
        return distance, jnp.where(depth > leave, depth, depth + step * voxel_m)

    def advance(_: jax.Array, march: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        _, depth = look(*march)
        return depth, word_at(depth)

    depth, word = jax.lax.fori_loop(0, STEPS - 1, advance, (depth, word_at(depth)))
    distance, further = look(depth, word)
    passed = ~(depth <= leave)
    met = ~passed & (distance < ARRIVED)
    return further, jnp.where(met, rays.reference_m + further, jnp.inf), met | passed


def _of_pixels(rays: TileRays) -> tuple[Vector, Vector]:
    """Start and direction of each pixel's ray, for rays with leaves (B, 1)."""
    column = np.arange(TILE_PIXELS, dtype=np.float32)[None] % TILE
    row = np.arange(TILE_PIXELS, dtype=np.float32)[None] // TILE
    change = [column * a + row * d for a, d in zip(rays.across, rays.down, strict=True)]
    return _plus(rays.start, [rays.reference_m * c for c in change]), _plus(rays.direction, change)


def _distance(
    table: jax.Array, first_voxel: jax.Array, size: Vector, point: Vector
) -> tuple[jax.Array, Vector]:
    """Signed distance of a point in voxels by the tangent plane of its voxel, and that plane's normal."""
    return _plane_distance(_word(table, first_voxel, size, point), size, point)


def _word(table: jax.Array, first_voxel: jax.Array, size: Vector, point: Vector) -> jax.Array:
    """The packed voxel that holds a point, or the nearest one."""
    i, j, k = _voxel(size, point)
    index = first_voxel + ((i * size[1] + j) * size[2] + k).astype(jnp.int32)
    return table.at[index].get(mode="clip")


def _plane_distance(word: jax.Array, size: Vector, point: Vector) -> tuple[jax.Array, Vector]:
    distance, *normal = unpacked(word)
    offset = [p - 0.5 - c for p, c in zip(point, _voxel(size, point), strict=True)]
    return distance + _dot(normal, offset), normal


def _voxel(size: Vector, point: Vector) -> Vector:
    return [jnp.floor(jnp.clip(p, 0.0, n - 0.5)) for p, n in zip(point, size, strict=True)]


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
