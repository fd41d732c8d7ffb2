"""The sheets of a triangle mesh nearest to the voxels of a grid: the surface and, at a thin wall, its back.

Scanned meshes have holes, flipped faces and inner walls: where the faces are not wound alike, a voxel is
inside if no path of voxels leads to it from the grid's border without touching the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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

STEPS = 2047
"""Of distance in a voxel, by which triangles are compared; of equally many the first counts."""

NUMBER_BITS = np.uint64(32)
"""Of a key: a triangle's number, below the steps of its distance."""

UNREACHED = np.uint64(2**64 - 1)

TOUCHING = 1e-3
"""Voxels from the surface up to which the way to it has no direction."""

HALF = 0.51
"""Voxels from the surface up to which a voxel may be on either side."""

EDGEWAYS = 0.3
"""Cosine between the way to the surface and its normal up to which the normal does not tell the side."""

ELSEWHERE = 0.5
"""Cosine between the normals of two sheets below which the second says more of the solid than the first."""

OPPOSITE = -0.3
SIDEWAYS = 0.25
"""Where the cosine is over `OPPOSITE` a sheet counts as so many voxels further: a thin wall's back first."""
WOUND = 0.99
"""Share of the edges that have both directions where the faces of a mesh are wound alike."""

CHUNK = 4096
"""Triangles per compiled call."""

VOXELS = 2**16
"""Voxels per compiled call, so that one kernel serves meshes of any size."""


@dataclass(frozen=True, kw_only=True)
class Sheets:
    """The two surface planes of every voxel that say most of the solid in it; leaves (X, Y, Z, ...).

    Attributes:
        distance: signed distance in voxels of the voxel's centre from the nearest sheet, positive outside.
        normal: (..., 3) its unit gradient.
        second_distance: from the tangent plane of the nearest sheet that faces elsewhere, within `BAND`.
        second_normal: (..., 3) outward; zero where there is no such sheet.
    """

    distance: NDArray[np.float32]
    normal: NDArray[np.float32]
    second_distance: NDArray[np.float32]
    second_normal: NDArray[np.float32]


def nearest_sheets(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], size: tuple[int, int, int]
) -> Sheets:
    """The sheets of a mesh nearest to the voxel centres (i + 0.5, j + 0.5, k + 0.5).

    Args:
        vertices: (V, 3) in voxels; the mesh lies half a voxel or more inside the grid.
        faces: (F, 3) vertex indices.
        size: voxels per axis.

    Returns:
        Leaves (size, ...). Exact within `BAND` of the surface; beyond, the distance to the triangle
        nearest to the nearest such voxel.
    """
    triangles = _subdivided(np.asarray(vertices, np.float32)[np.asarray(faces)], LONGEST_EDGE)
    reached = _Reached.of(triangles, size)
    nearest = reached.nearest()
    unseen = nearest < 0
    features = np.zeros((3, *size), np.int32)
    ndimage.distance_transform_edt(unseen, return_distances=False, return_indices=True, indices=features)
    nearest = nearest[tuple(features)]
    offset = _offset_of_voxels(triangles, nearest)
    distance = np.linalg.norm(offset, axis=-1)
    outside, inside = _regions(distance)
    outward = _outward(triangles, np.asarray(faces), outside, inside)
    sign = _signs(distance, offset, outward[nearest], outside, inside)
    touching = (distance < TOUCHING)[..., None]
    gradient = offset * (sign / np.maximum(distance, 1e-9))[..., None]
    second = reached.nearest_elsewhere(outward, nearest)
    apart = triangles.mean(axis=1)[second] - triangles.mean(axis=1)[nearest]
    across = outward[second]
    convex = (second >= 0) & (((outward[nearest] - across) * apart).sum(axis=-1) < 0)
    from_second = _offset_of_voxels(triangles, np.maximum(second, 0))
    return Sheets(
        distance=distance * sign,
        normal=np.where(touching, outward[nearest], gradient),
        second_distance=(across * from_second).sum(axis=-1),
        second_normal=np.where(convex[..., None], across, np.float32(0)),
    )


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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Reached:
    """Voxels within `BAND` of triangles.

    Attributes:
        voxel: (P,) flat indices.
        key: (P,) uint64, the distance in the upper bits and the triangle's number in the lower `NUMBER_BITS`.
        size: of the grid.
    """

    voxel: NDArray[np.intp]
    key: NDArray[np.uint64]
    size: tuple[int, int, int]

    @classmethod
    def of(cls, triangles: NDArray[np.float32], size: tuple[int, int, int]) -> _Reached:
        """Those of triangles (T, 3, 3) in a grid."""
        padding = -len(triangles) % CHUNK
        padded = np.concatenate([triangles, np.full((padding, 3, 3), -1e3, np.float32)])
        voxels, keys = [], []
        for start in range(0, len(padded), CHUNK):
            reached = _reached(padded[start : start + CHUNK], np.asarray(size, np.int32))
            index, steps = map(np.asarray, reached)
            inside = index >= 0
            number = (start + np.nonzero(inside)[0]).astype(np.uint64)
            voxels.append(index[inside].astype(np.intp))
            keys.append(steps[inside].astype(np.uint64) << NUMBER_BITS | number)
        return cls(voxel=np.concatenate(voxels), key=np.concatenate(keys), size=size)

    @property
    def triangle(self) -> NDArray[np.intp]:
        """Number (P,) of the triangle."""
        return _number(self.key).astype(np.intp)

    def nearest(self) -> NDArray[np.int32]:
        """Index (size) of the nearest triangle, -1 where none is near."""
        best = np.full(int(np.prod(self.size)), UNREACHED)
        np.minimum.at(best, self.voxel, self.key)
        nearest = _number(best).astype(np.int32)
        nearest[best == UNREACHED] = -1
        return nearest.reshape(self.size)

    def nearest_elsewhere(
        self, outward: NDArray[np.float32], nearest: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """The nearest triangle that faces elsewhere than that of a number (size), by normals (T, 3)."""
        there = outward[nearest.ravel()[self.voxel]]
        cosine = (there * outward[self.triangle]).sum(axis=1)
        elsewhere = cosine < ELSEWHERE
        penalty = np.uint64(SIDEWAYS * STEPS) << NUMBER_BITS
        key = (self.key + np.where(cosine > OPPOSITE, penalty, np.uint64(0)))[elsewhere]
        return replace(self, voxel=self.voxel[elsewhere], key=key).nearest()


def _number(key: NDArray[np.uint64]) -> NDArray[np.uint64]:
    return key & ((np.uint64(1) << NUMBER_BITS) - np.uint64(1))


@jax.jit
def _reached(triangles, size):
    """Flat indices (T, REACH^3) of the voxels round triangles (T, 3, 3), -1 beyond `BAND`, and distances."""
    corner = jnp.floor(triangles.min(axis=1) - BAND).astype(jnp.int32)
    block = np.stack(np.meshgrid(*[np.arange(REACH)] * 3, indexing="ij")).reshape(3, -1)
    i, j, k = (corner[:, axis, None] + block[axis, None] for axis in range(3))
    x, y, z = offset_from_triangle((i + 0.5, j + 0.5, k + 0.5), triangles[:, None])
    square = x * x + y * y + z * z
    inside = (
        (square <= BAND**2) & (i >= 0) & (i < size[0]) & (j >= 0) & (j < size[1]) & (k >= 0) & (k < size[2])
    )
    steps = (jnp.sqrt(square) * STEPS).astype(jnp.uint32)
    return jnp.where(inside, (i * size[1] + j) * size[2] + k, -1), steps


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


def _regions(distance):
    """Voxels that a path from the grid's border reaches without touching the surface, and those shut in."""
    near = distance <= HALF
    free = np.pad(~near, 1, constant_values=True)
    regions = np.zeros(free.shape, np.int32)
    ndimage.label(free, output=regions)
    outside = (regions == regions[0, 0, 0])[1:-1, 1:-1, 1:-1]
    return outside, ~near & ~outside


def _region_ahead(outside, inside, points, directions):
    """+1 outside, -1 inside or 0 (P,): the first region met from points (P, 3) along directions."""
    found = np.zeros(len(points), np.int8)
    limit = np.array(outside.shape) - 1
    for step in (0.0, 0.75, 1.25, 1.75, 2.25):
        there = np.clip(np.floor(points + step * directions).astype(int), 0, limit)
        here = outside[tuple(there.T)].astype(np.int8) - inside[tuple(there.T)].astype(np.int8)
        np.copyto(found, here, where=found == 0)
    return found


def _are_wound_alike(faces):
    """Whether nearly every edge of the faces (F, 3) is run through once in either direction."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    there, back = (np.sort(edges[:, i] * (faces.max() + 1) + edges[:, 1 - i]) for i in (0, 1))
    return bool((there == back).mean() > WOUND)


def _outward(triangles, faces, outside, inside):
    """Unit normals (T, 3) that point out of the solid.

    By the order of the corners where the faces are wound alike; else by the regions on both sides, and by
    what most of the others tell of that order where both are outside, as at a thin wall.
    """
    normal = _unit(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    volume = np.sign((triangles[:, 0] * np.cross(triangles[:, 1], triangles[:, 2])).sum()) or np.float32(1)
    if _are_wound_alike(faces):
        return normal * volume
    middle = triangles.mean(axis=1)
    front, back = (_region_ahead(outside, inside, middle, sign * normal) for sign in (1, -1))
    told = (front - back) // 2
    return normal * np.where(told != 0, told, np.sign(told.sum()) or volume).astype(np.float32)[:, None]


def _signs(distance, offset, outward, outside, inside):
    """+1 outside and -1 inside of the solid, for every voxel."""
    sign = np.where(outside, 1.0, -1.0).astype(np.float32)
    near = np.flatnonzero(distance < BAND)
    way = offset.reshape(-1, 3)[near]
    side = (way * outward.reshape(-1, 3)[near]).sum(axis=1)
    edgeways = np.abs(side) < EDGEWAYS * distance.ravel()[near]
    where = np.stack(np.unravel_index(near, distance.shape), axis=1) + 0.5
    ahead = _region_ahead(outside, inside, where, _unit(way))
    sign.ravel()[near] = np.where(np.where(edgeways & (ahead != 0), ahead, side) < 0, -1.0, 1.0)
    return sign


def _unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-20)
