"""First intersections of pixel rays with posed objects, by stepping through their distance fields.

A ray is p(z) = origin + z direction in the object's voxel coordinates, where z is depth in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from shapes.geometry.camera import Camera
from shapes.rendering.object_library import LEVELS, WORDS, ObjectLibrary, level_of, unpack, unpack_second
from shapes.rendering.tiles import TILE, TILE_PIXELS

PAST = 0.01
"""Voxels by which a ray steps past the border of a voxel, so that it is in the next one."""
LEAST_RATE = 1e-6
"""Voxels per metre: what is slower stands still."""
SHORT = 0.25
"""Voxels before the surface at which rays that approach it stop, to look at both planes from there."""
APPROACH_STEPS = 4
"""Looks at the nearest plane alone, which costs half, before those at both; three or six make it slower."""
STEPS = (1, 6, 12, 24)
"""After each of these the rays that are not done go on by themselves."""
SHRINKING = 8
"""How many times fewer rays go on together."""

CONE_STEPS = 12
"""Steps of the coarse march of a tile's cone: speed."""

SLACK = 0.3
"""Voxels by which the distance by a voxel's plane may overrate the true one."""

VOXELS_PER_PIXEL = 4.0
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
        scale: (N, 3) by which objects are larger along their own axes, about their origin; None: as they are.
    """

    object_index: jax.Array
    camera_from_object: jax.Array
    camera_index: jax.Array
    scale: jax.Array | None = None

    def __len__(self) -> int:
        return len(self.object_index)


def in_single_precision(posed: PosedObjects, cameras: Camera) -> tuple[PosedObjects, Camera]:
    """The same in int32 and float32, as kernels want them, whatever precision chains run in."""
    posed = PosedObjects(
        jnp.asarray(posed.object_index, jnp.int32),
        jnp.asarray(posed.camera_from_object, jnp.float32),
        jnp.asarray(posed.camera_index, jnp.int32),
        None if posed.scale is None else jnp.asarray(posed.scale, jnp.float32),
    )
    return posed, jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cameras)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rays:
    """Bundles of rays, p(z) = origin + z direction with z depth in metres; leaves of shapes that broadcast.

    A bundle belongs to an image, or to a tile of it.

    Attributes:
        origin: the camera's centre, in voxels.
        direction: of the bundle's first pixel, in voxels per metre of depth.
        across: change of `direction` from one column to the next.
        down: the same from one row to the next.
        size: voxels per axis, as floats.
        first_voxel: of the object in the table.
        nearest_m: least depth, of the bounding sphere or just before the camera.
        furthest_m: greatest depth, of the bounding sphere.
    """

    origin: Vector
    direction: Vector
    across: Vector
    down: Vector
    size: Vector
    first_voxel: jax.Array
    nearest_m: jax.Array
    furthest_m: jax.Array


def image_rays(library: ObjectLibrary, posed: PosedObjects, cameras: Camera) -> Rays:
    """The rays of each posed object's image; leaves (N,).

    Of a scaled object they are those of a camera that is scaled the other way, in the object as it is.
    """
    model = posed.object_index
    scale = [1.0] * 3 if posed.scale is None else posed.scale.T
    pose = posed.camera_from_object.reshape(-1, 16).T
    rotation, translation = [pose[4 * r : 4 * r + 3] for r in range(3)], pose[3:12:4]
    camera = jax.tree.map(itemgetter(posed.camera_index), cameras)
    grid_origin = library.grid_origin_m.T[:, model]
    centre = [part * by for part, by in zip(library.centre_m.T[:, model], scale, strict=True)]
    depth_of_centre = _dot(rotation[2], centre) + translation[2]
    radius = library.radius_m[model] * (1.0 if posed.scale is None else jnp.max(posed.scale, axis=1))
    pixel = jnp.maximum(depth_of_centre - radius, 0.05 * radius) / jnp.maximum(camera.fx, camera.fy)
    level = _level_of_detail(library.pitch_m[model], pixel)
    pitch, size, first_voxel = level_of(library, model, level)
    # grid axis a of a camera vector c: sum_b rotation[b][a] c[b] / (pitch scale[a])
    to_grid = [[rotation[b][a] / (pitch * scale[a]) for b in range(3)] for a in range(3)]
    corner = (-camera.cx / camera.fx, -camera.cy / camera.fy, jnp.ones_like(pitch))
    return Rays(
        origin=[-_dot(to_grid[a], translation) - grid_origin[a] / pitch for a in range(3)],
        direction=[_dot(to_grid[a], corner) for a in range(3)],
        across=[to_grid[a][0] / camera.fx for a in range(3)],
        down=[to_grid[a][1] / camera.fy for a in range(3)],
        size=[axis.astype(jnp.float32) for axis in size],
        first_voxel=first_voxel,
        nearest_m=jnp.maximum(depth_of_centre - radius, NEAREST_M),
        furthest_m=depth_of_centre + radius,
    )


def tile_rays(images: Rays, view: jax.Array, row: jax.Array, column: jax.Array) -> Rays:
    """The rays of tiles (B,) of images `view`, at `row` and `column` counted in tiles."""
    rays = gather(images, view)
    return replace(rays, direction=_direction(rays, column * TILE, row * TILE))


def gather(rays: Rays, index: jax.Array) -> Rays:
    """Bundles by index, looked up here: the compiler would do it again wherever one of them is used."""
    return jax.lax.optimization_barrier(jax.tree.map(itemgetter(index), rays))


def _level_of_detail(pitch_m: jax.Array, pixel_m: jax.Array) -> jax.Array:
    """The coarsest level (B,) that pixels of this size allow, for objects with this finest pitch."""
    coarser = [pixel_m >= VOXELS_PER_PIXEL * 2**level * pitch_m for level in range(1, LEVELS)]
    return jnp.stack(coarser).sum(axis=0, dtype=jnp.int32)


def free_depth(table: jax.Array, rays: Rays) -> jax.Array:
    """Depth (B,) up to which the whole tile sees nothing; +inf where it sees nothing at all.

    Cone marching: the rays of a tile stay within `spread` times the depth of the central one.
    """
    half = (TILE - 1) / 2
    direction = _direction(rays, half, half)
    spread = half * jnp.sqrt(_dot(rays.across, rays.across) + _dot(rays.down, rays.down))
    pace = 1.0 / (_length(direction) + spread)

    def advance(_: jax.Array, depth: jax.Array) -> jax.Array:
        point = [p + depth * d for p, d in zip(rays.origin, direction, strict=True)]
        inside = [jnp.clip(p, 0.0, n - 0.5) for p, n in zip(point, rays.size, strict=True)]
        outside = [p - q for p, q in zip(point, inside, strict=True)]
        beyond = jnp.sqrt(_dot(outside, outside))
        distance, _ = _plane_distance(_word(table, rays, inside), inside)
        clearance = jnp.maximum(distance - beyond, beyond) - SLACK
        return depth + jnp.maximum((clearance - depth * spread) * pace, 0.0)

    depth = jax.lax.fori_loop(0, CONE_STEPS, advance, rays.nearest_m)
    return jnp.where(depth <= rays.furthest_m, depth, jnp.inf)


def first_hits(table: jax.Array, tiles: Rays, free: jax.Array) -> jax.Array:
    """Depth in metres (B, TILE_PIXELS) where each ray first meets the surface, +inf where it meets none.

    A few rays graze the surface and need many steps: they go on by themselves, without the others.

    Args:
        table: of the library.
        tiles: rays of B tiles.
        free: (B,) of `free_depth`; +inf where nothing shall be looked for.
    """
    number = jnp.arange(TILE_PIXELS, dtype=jnp.int32)[None]
    rays = jax.tree.map(lambda leaf: leaf[:, None], tiles)
    start = jnp.broadcast_to(free[:, None], (len(free), TILE_PIXELS))
    reached = advance(table, rays, number, start, STEPS[0], APPROACH_STEPS).reshape(-1)
    pixel = jnp.arange(len(reached), dtype=jnp.int32)
    hits = jnp.where(reached < 0, -reached, jnp.inf)
    return _continued(table, tiles, pixel, reached, hits, STEPS[1:]).reshape(-1, TILE_PIXELS)


def _continued(
    table: jax.Array,
    tiles: Rays,
    pixel: jax.Array,
    reached: jax.Array,
    hits: jax.Array,
    steps: tuple[int, ...],
) -> jax.Array:
    """The hits (B * TILE_PIXELS,) with those of rays (P,) that are not done where `advance` left them."""
    if not steps:
        return hits
    order, count = sort_chosen_first((reached >= 0) & jnp.isfinite(reached))
    together = len(pixel) // SHRINKING

    def march(turn: jax.Array, hits: jax.Array) -> jax.Array:
        mine = jax.lax.dynamic_slice_in_dim(order, turn * together, together)
        there = turn * together + jnp.arange(together, dtype=jnp.int32) < count
        where = pixel[mine]
        rays = gather(tiles, where // TILE_PIXELS)
        depth = jnp.where(there, reached[mine], jnp.inf)
        further = advance(table, rays, where % TILE_PIXELS, depth, steps[0])
        place = jnp.where(further < 0, where, len(hits))
        hits = hits.at[place].set(-further, mode="drop", unique_indices=True)
        return _continued(table, tiles, where, further, hits, steps[1:])

    return jax.lax.fori_loop(0, -(-count // together), march, hits)


def sort_chosen_first(chosen: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Indices (N,) of which the first are those of the chosen (N,), in order, and the number of these."""
    filled = jnp.pad(chosen, (0, -len(chosen) % TILE_PIXELS))
    groups = filled.reshape(-1, TILE_PIXELS).astype(jnp.float32)
    within = groups @ np.triu(np.ones((TILE_PIXELS, TILE_PIXELS), np.float32))  # faster than a long sum
    before = jnp.cumsum(within[:, -1]) - within[:, -1]
    place = (within + before[:, None]).astype(jnp.int32).reshape(-1)[: len(chosen)] - 1
    number = jnp.arange(len(chosen), dtype=jnp.int32)
    target = jnp.where(chosen, place, len(chosen))
    order = jnp.zeros_like(number).at[target].set(number, mode="drop", unique_indices=True)
    return order, place[-1] + 1


def advance(
    table: jax.Array, rays: Rays, number: jax.Array, depth: jax.Array, steps: int, approach_steps: int = 0
) -> jax.Array:
    """Depths of pixels `number` of tiles after so many steps; negated where the surface is met, +inf beyond.

    First by sphere tracing (Hart 1996), with the nearest plane alone, up to just before the surface. Then
    from voxel to voxel (Amanatides and Woo 1987): the solid of a voxel is what lies in it behind its planes,
    and the ray meets the first of these pieces that it enters, at its plane or at the voxel's border. So
    what is rendered is one rigid shape, whatever the poses: where rays begin and stop decides nothing.
    """
    column, row = number % TILE, number // TILE
    direction = _direction(rays, column, row)
    enter, leave = _crossing(rays, direction)
    voxel_m = 1.0 / _length(direction)

    def point_at(depth: jax.Array) -> Vector:
        point = [p + depth * d for p, d in zip(rays.origin, direction, strict=True)]
        return [jnp.clip(p, 0.0, n - 0.5) for p, n in zip(point, rays.size, strict=True)]

    def approach(_: int, depth: jax.Array) -> jax.Array:
        point = point_at(depth)
        clear = jnp.abs(_plane_distance(_word(table, rays, point), point)[0])
        return depth + jnp.maximum(clear - SHORT, 0.0) * voxel_m

    def look(_: int, depth: jax.Array) -> jax.Array:
        point = point_at(jnp.abs(depth))  # met surfaces have negated depths
        # computed once: the compiler would look them up again wherever one of them is used
        words = jax.lax.optimization_barrier(_words(table, rays, point))
        distance, first, last = _stay(words, point, direction)
        border = _way_out(point, direction)
        first, last = jnp.maximum(first, 0.0), jnp.minimum(last, border)
        step = jnp.maximum(border + PAST * voxel_m, (distance - SLACK) * voxel_m)
        further = jnp.where(first < last, -jnp.maximum(depth + first, NEAREST_M), depth + step)
        return jnp.where(depth < 0, depth, further)

    depth = jnp.maximum(depth, enter)
    depth = jax.lax.fori_loop(0, approach_steps, approach, depth)
    depth = jax.lax.fori_loop(0, steps, look, depth)
    # one array, computed once: three would each look at the voxel again
    return jax.lax.optimization_barrier(jnp.where(jnp.abs(depth) <= leave, depth, jnp.inf))


def _direction(rays: Rays, column: Any, row: Any) -> Vector:
    """Of the pixels at this column and row of the tile."""
    return [d + column * a + row * b for d, a, b in zip(rays.direction, rays.across, rays.down, strict=True)]


def _word(table: jax.Array, rays: Rays, point: Vector) -> jax.Array:
    """The packed nearest plane of the voxel that holds a point of the grid."""
    return _words(table, rays, point)[0]


def _words(table: jax.Array, rays: Rays, point: Vector) -> list[jax.Array]:
    """Both packed planes of the voxel that holds a point of the grid."""
    i, j, k = (jnp.floor(p) for p in point)
    index = WORDS * (rays.first_voxel + ((i * rays.size[1] + j) * rays.size[2] + k).astype(jnp.int32))
    return [
        table.at[index + word].get(mode="promise_in_bounds", wrap_negative_indices=False)
        for word in range(WORDS)
    ]


def _plane_distance(word: jax.Array, point: Vector) -> tuple[jax.Array, Vector]:
    """Signed distance of a point in voxels by the tangent plane of its voxel, and that plane's normal."""
    distance, *normal = unpack(word)
    return distance + _dot(normal, [p - jnp.floor(p) - 0.5 for p in point]), normal


def _stay(
    words: Sequence[jax.Array], point: Vector, direction: Vector
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distance of a point from the nearest sheet in voxels, and a ray's stay in the solid of its voxel.

    The solid is what lies behind both of the voxel's planes. Behind one that the ray comes nearer to, at a
    rate a > 0, it is from s / a on, and behind one that it moves away from until then.

    Returns:
        Distance, and the depths in metres from the point on at which the ray enters the solid and leaves it;
        in the other order where it misses it.
    """
    offset = [p - jnp.floor(p) - 0.5 for p in point]
    enter, leave, distances = [], [], []
    for word, unpacked in zip(words, (unpack, unpack_second), strict=True):
        distance, *normal = unpacked(word)
        distance = distance + _dot(normal, offset)
        rate = -_dot(normal, direction)
        facing = rate > 0
        crossing = distance / jnp.where(facing, jnp.maximum(rate, LEAST_RATE), jnp.minimum(rate, -LEAST_RATE))
        enter.append(jnp.where(facing, crossing, -jnp.inf))
        leave.append(jnp.where(facing, jnp.inf, crossing))
        distances.append(distance)
    return distances[0], jnp.maximum(*enter), jnp.minimum(*leave)


def _way_out(point: Vector, direction: Vector) -> jax.Array:
    """Metres of depth from a point to where the ray leaves its voxel."""
    ways = []
    for p, d in zip(point, direction, strict=True):
        ahead = jnp.where(d > 0, jnp.floor(p) + 1 - p, p - jnp.floor(p))
        ways.append(ahead / jnp.maximum(jnp.abs(d), LEAST_RATE))
    return jnp.minimum(jnp.minimum(*ways[:2]), ways[2])


def _crossing(rays: Rays, direction: Vector) -> tuple[jax.Array, jax.Array]:
    """Depths at which rays enter and leave the grid; enter > leave for those that pass it by."""
    enter, leave = [], []
    for p, d, n in zip(rays.origin, direction, rays.size, strict=True):
        inverse = 1.0 / jnp.where(jnp.abs(d) < 1e-9, 1e-9, d)
        low, high = -p * inverse, (n - p) * inverse
        enter.append(jnp.minimum(low, high))
        leave.append(jnp.maximum(low, high))
    leave = jnp.minimum(jnp.minimum(*leave[:2]), leave[2])
    return jnp.maximum(jnp.maximum(*enter[:2]), enter[2]), jnp.minimum(leave, rays.furthest_m)


def _length(a: Vector) -> jax.Array:
    return jnp.sqrt(_dot(a, a))


def _dot(a: Vector, b: Vector) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
