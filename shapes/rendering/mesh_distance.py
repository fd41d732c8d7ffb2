"""Signed distance of a triangle mesh on a grid: exact near the surface, sign by what the outside can reach.

Scanned meshes have holes, flipped faces and inner walls, so the sign does not come from normals: a voxel
is inside if no path of voxels leads to it from the grid's border without touching the surface. Where a
wall is thinner than a voxel both sides are outside and the distance is unsigned.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

LONGEST_EDGE = 1.5
"""Triangles are split until no edge is longer, in voxels."""

BAND = 1.0
"""Distance in voxels within which the nearest triangle is found exactly."""

REACH = 5
"""Voxels per axis in which one triangle can be nearest: LONGEST_EDGE + 2 BAND, rounded outwards."""

UNREACHED = 2**32 - 1

CHUNK = 4096
"""Triangles per compiled call."""

VOXELS = 2**16
"""Voxels per compiled call, so that one kernel serves meshes of any size."""


def signed_distance(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], size: tuple[int, int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Signed distance to a mesh at the voxel centres (i + 0.5, j + 0.5, k + 0.5), positive outside.

    Args:
        vertices: (V, 3) in voxels; the mesh lies at least two voxels inside the grid.
        faces: (F, 3) vertex indices.
        size: voxels per axis.

    Returns:
        Distance (size) in voxels and its unit gradient (size, 3). Exact within 1.5 voxels of the
        surface; beyond, the distance to the triangle nearest to the nearest such voxel.
    """
    triangles = _subdivided(np.asarray(vertices, np.float32)[np.asarray(faces)], LONGEST_EDGE)
    nearest = _nearest_triangle(triangles, size)
    unseen = nearest < 0
    features = np.zeros((3, *size), np.int32)
    ndimage.distance_transform_edt(unseen, return_distances=False, return_indices=True, indices=features)
    nearest = nearest[tuple(features)]
    offset = _offset_of_voxels(triangles, nearest)
    distance = np.linalg.norm(offset, axis=-1)
    normal = _unit(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    touching = distance < 1e-3
    direction = np.where(touching[..., None], normal[nearest], offset / np.maximum(distance, 1e-9)[..., None])
    return _signed(distance, direction, touching)


def _subdivided(triangles: NDArray[np.float32], longest: float) -> NDArray[np.float32]:
    """Triangles (T, 3, 3) split at the midpoint of their longest edge until none exceeds `longest`."""
    done = []
    while len(triangles):
        edges = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=-1)
        long = edges.max(axis=1) > longest
        done.append(triangles[~long])
        triangles, edges = triangles[long], edges[long]
        rows = np.arange(len(triangles))
        first = edges.argmax(axis=1)
        a, b, c = (triangles[rows, (first + corner) % 3] for corner in range(3))
        middle = (a + b) * np.float32(0.5)
        halves = [np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)]
        triangles = np.concatenate(halves, dtype=np.float32)
    return np.concatenate(done)


def _nearest_triangle(triangles: NDArray[np.float32], size: tuple[int, int, int]) -> NDArray[np.int32]:
    """Index of the nearest triangle for voxels within 1.5 of the surface, -1 beyond; (size)."""
    padding = -len(triangles) % CHUNK
    padded = np.concatenate([triangles, np.full((padding, 3, 3), -1e3, np.float32)])
    count = int(np.prod(size))
    best = jnp.asarray(np.full(1 << (count - 1).bit_length(), UNREACHED, np.uint32))
    for start in range(0, len(padded), CHUNK):
        best = _lower(best, *_reached(padded[start : start + CHUNK], start, np.asarray(size, np.int32)))
    best = np.asarray(best)[:count].reshape(size)
    nearest = (best & (2**20 - 1)).astype(np.int32)
    nearest[best == UNREACHED] = -1
    return nearest


@partial(jax.jit, donate_argnums=0)
def _lower(best, index, key):
    return best.at[index].min(key, mode="drop")


@jax.jit
def _reached(triangles, start, size):
    """Flat indices (T, REACH^3) and squared distances of the voxels round triangles (T, 3, 3).

    Voxels that are not reached have an index past every grid's end.
    """
    corner = jnp.floor(triangles.min(axis=1) - BAND).astype(jnp.int32)
    block = np.stack(np.meshgrid(*[np.arange(REACH)] * 3, indexing="ij")).reshape(3, -1)
    i, j, k = (corner[:, axis, None] + block[axis, None] for axis in range(3))
    x, y, z = offset_from_triangle((i + 0.5, j + 0.5, k + 0.5), triangles[:, None])
    square = x * x + y * y + z * z
    inside = (
        (square <= BAND**2) & (i >= 0) & (i < size[0]) & (j >= 0) & (j < size[1]) & (k >= 0) & (k < size[2])
    )
    name = start + jnp.arange(len(triangles), dtype=jnp.uint32)[:, None]
    key = (jnp.sqrt(square) * 4095).astype(jnp.uint32) << 20 | name
    return jnp.where(inside, (i * size[1] + j) * size[2] + k, np.iinfo(np.int32).max), key


def _offset_of_voxels(triangles: NDArray[np.float32], nearest: NDArray[np.int32]) -> NDArray[np.float32]:
    """Vectors (size, 3) to voxel centres from the triangles (T, 3, 3) of the given numbers (size)."""
    offset = np.empty((nearest.size, 3), np.float32)
    for start in range(0, nearest.size, VOXELS):
        which = nearest.ravel()[start : start + VOXELS]
        centre = np.stack(np.unravel_index(start + np.arange(len(which)), nearest.shape)) + np.float32(0.5)
        padding = VOXELS - len(which)
        mine = _offset(np.pad(centre, ((0, 0), (0, padding))), triangles[np.pad(which, (0, padding))])
        offset[start : start + VOXELS] = np.asarray(mine).T[: len(which)]
    return offset.reshape(*nearest.shape, 3)


@jax.jit
def _offset(centre, triangles):
    return jnp.stack(offset_from_triangle(centre, triangles))


def offset_from_triangle(point: Sequence[jax.Array], triangle: jax.Array) -> tuple[jax.Array, ...]:
    """Components of the vectors from the nearest points of triangles to points (Ericson 2005, 5.1.5).

    Args:
        point: x, y, z, each (...).
        triangle: (..., 3 corners, 3); broadcasts against the points.
    """
    a, b, c = ([triangle[..., corner, axis] for axis in range(3)] for corner in range(3))
    ab, ac, ap = _minus(b, a), _minus(c, a), _minus(point, a)
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    d3, d4 = d1 - _dot(ab, ab), d2 - _dot(ab, ac)
    d5, d6 = d1 - _dot(ab, ac), d2 - _dot(ac, ac)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    total = jnp.maximum(va + vb + vc, 1e-20)
    v, w = vb / total, vc / total
    on_bc = (va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0)
    along_bc = (d4 - d3) / jnp.maximum((d4 - d3) + (d5 - d6), 1e-20)
    v, w = jnp.where(on_bc, 1 - along_bc, v), jnp.where(on_bc, along_bc, w)
    on_ac = (vb <= 0) & (d2 >= 0) & (d6 <= 0)
    v, w = jnp.where(on_ac, 0.0, v), jnp.where(on_ac, d2 / jnp.maximum(d2 - d6, 1e-20), w)
    on_ab = (vc <= 0) & (d1 >= 0) & (d3 <= 0)
    v, w = jnp.where(on_ab, d1 / jnp.maximum(d1 - d3, 1e-20), v), jnp.where(on_ab, 0.0, w)
    at_c = (d6 >= 0) & (d5 <= d6)
    v, w = jnp.where(at_c, 0.0, v), jnp.where(at_c, 1.0, w)
    at_b = (d3 >= 0) & (d4 <= d3)
    v, w = jnp.where(at_b, 1.0, v), jnp.where(at_b, 0.0, w)
    at_a = (d1 <= 0) & (d2 <= 0)
    v, w = jnp.where(at_a, 0.0, v), jnp.where(at_a, 0.0, w)
    return tuple(p - v * q - w * r for p, q, r in zip(ap, ab, ac, strict=True))


def _minus(a, b):
    return [p - q for p, q in zip(a, b, strict=True)]


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _signed(distance, direction, touching):
    """Distance and gradient with the sign of what the border of the grid can reach."""
    near = distance <= 0.51
    regions = np.zeros(near.shape, np.int32)
    ndimage.label(~near, output=regions)
    outside = regions == regions[0, 0, 0]
    inside = ~near & ~outside

    index = np.argwhere(near)
    walk = direction[near]
    side = np.zeros(len(index), np.int8)
    back = np.zeros(len(index), np.int8)
    limit = np.array(distance.shape) - 1
    for step in (0.75, 1.25, 1.75, 2.25):
        for sign, found in ((1, side), (-1, back)):
            there = np.clip(np.floor(index + 0.5 + sign * step * walk).astype(int), 0, limit)
            here = outside[tuple(there.T)].astype(np.int8) - inside[tuple(there.T)].astype(np.int8)
            np.copyto(found, here, where=found == 0)
    inward = (side < 0) | ((side == 0) & (back > 0) & touching[near])
    sign = np.where(outside, 1.0, -1.0).astype(np.float32)
    sign[near] = np.where(inward, -1.0, 1.0)
    return distance * sign, direction * sign[..., None]


def _unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-20)
