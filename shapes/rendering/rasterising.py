"""Rasterised triangle meshes at many poses at once: the pixels that each covers, for small images.

Exact at pixel centres for any closed mesh, with the triangle that is seen there, and exact in the share of
each pixel's square that is filled; cost grows with covered pixels, not with the image. NumPy alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics
from shapes.rendering.outlines import Outlines, Windows, covered_areas

NEAREST_M = 1e-3
"""Triangles that reach nearer to the camera than this are not seen."""
LEAST_FILL = 1e-3
"""Share of a pixel's square below which it is left out: a quarter of a step of 8 bits."""
NEIGHBOURS = ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
"""Rows and columns from a pixel whose centre is not covered to those that lend it their triangle."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Closed triangles.

    Attributes:
        vertices_m: (V, 3).
        faces: (F, 3), counter-clockwise from outside.
    """

    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int64]

    @cached_property
    def normals(self) -> NDArray[np.float64]:
        """Normals (F, 3) to the outside, twice as long as the triangles are large."""
        corner = self.vertices_m[self.faces]
        return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])

    @cached_property
    def offsets(self) -> NDArray[np.float64]:
        """Of the triangles' planes (F,): n . x."""
        return (self.normals * self.vertices_m[self.faces[:, 0]]).sum(axis=1)

    @cached_property
    def edges(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Vertices (E, 2), and the triangles (E, 2) that run along them and against; F for none."""
        _, first, same = np.unique(self.vertices_m, axis=0, return_index=True, return_inverse=True)
        faces = first[same.ravel()][self.faces]
        ends = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
        against = (ends[:, 0] > ends[:, 1]).astype(np.int64)
        key = np.sort(ends, axis=1) @ np.array([len(self.vertices_m), 1])
        pairs = np.stack([key, _ranks(2 * key + against)], axis=1)
        unique, number = np.unique(pairs, axis=0, return_inverse=True)
        triangles = np.full((len(unique), 2), len(faces))
        triangles[number.ravel(), against] = np.repeat(np.arange(len(faces)), 3)
        return np.stack(np.divmod(unique[:, 0], len(self.vertices_m)), axis=1), triangles


@dataclass(frozen=True, eq=False)
class MeshSet:
    """Meshes (M,) in arrays of one shape, so that any of them are rendered together.

    Attributes:
        vertices_m: (M, V, 3).
        faces: (M, F, 3).
        normals: (M, F, 3); 0 of triangles that fill up.
        offsets: (M, F) of their planes.
        ends: (M, E, 2) vertices of edges.
        sides: (M, E, 2) triangles along and against them; F where there is none.
    """

    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    ends: NDArray[np.int64]
    sides: NDArray[np.int64]

    @classmethod
    def of(cls, meshes: Sequence[Mesh]) -> MeshSet:
        """Fill up."""
        most = max(len(mesh.faces) for mesh in meshes)
        sides = [np.where(mesh.edges[1] == len(mesh.faces), most, mesh.edges[1]) for mesh in meshes]
        return cls(
            vertices_m=_filled_up([mesh.vertices_m for mesh in meshes], 0.0),
            faces=_filled_up([mesh.faces for mesh in meshes], 0),
            normals=_filled_up([mesh.normals for mesh in meshes], 0.0),
            offsets=_filled_up([mesh.offsets for mesh in meshes], 0.0),
            ends=_filled_up([mesh.edges[0] for mesh in meshes], 0),
            sides=_filled_up(sides, most),
        )


def _filled_up(arrays: Sequence[NDArray], value: float) -> NDArray:
    filled = np.full((len(arrays), max(map(len, arrays)), *arrays[0].shape[1:]), value, arrays[0].dtype)
    for row, array in zip(filled, arrays, strict=True):
        row[: len(array)] = array
    return filled


@dataclass(frozen=True, eq=False)
class Fragments:
    """Pixels covered by each of B renderings; those of rendering b are rows `start[b]` to `start[b + 1]`.

    Attributes:
        start: (B + 1,) int64.
        pixel: (P,) int64, row * width + column, ascending within a rendering.
        depth_m: (P,) float32 along the optical axis.
        face: (P,) int64 triangle that is seen.
        source: (P,) int64 the pixel at whose centre it is seen: itself, or one beside it.
        fill: (P,) share of the pixel's square that is covered.
        fill_change: (P, K) its rate of change under each of K motions.
    """

    start: NDArray[np.int64]
    pixel: NDArray[np.int64]
    depth_m: NDArray[np.float32]
    face: NDArray[np.int64]
    source: NDArray[np.int64]
    fill: NDArray[np.float64]
    fill_change: NDArray[np.float64]


def rasterise(
    meshes: MeshSet,
    which: NDArray[np.int64],
    camera_from_object: NDArray[np.float64],
    camera: CameraIntrinsics,
    twists: NDArray[np.float64] | None = None,
) -> Fragments:
    """What is seen of closed meshes at B poses, each alone.

    Args:
        meshes: that may be seen.
        which: (B,) number of each one's mesh.
        camera_from_object: (B, 4, 4) rigid.
        camera: of the image.
        twists: (B, K, 6) motions of each, velocity of the camera's origin and angular velocity.
    """
    twists = np.zeros((len(which), 0, 6)) if twists is None else twists
    rotation, origin = camera_from_object[:, :3, :3], camera_from_object[:, None, :3, 3]
    points = meshes.vertices_m[which] @ rotation.swapaxes(1, 2) + origin
    inverse = 1 / np.maximum(points[..., 2], NEAREST_M)
    projected = np.empty(points.shape)
    projected[..., 0] = camera.fx * points[..., 0] * inverse + camera.cx
    projected[..., 1] = camera.fy * points[..., 1] * inverse + camera.cy
    projected[..., 2] = inverse
    facing = _facing(meshes, which, camera_from_object)
    if points.size and points[..., 2].min() <= NEAREST_M:
        thing = np.arange(len(which))[:, None, None]
        facing[:, :-1] &= (inverse[thing, meshes.faces[which]] < 1 / NEAREST_M).all(axis=2)
    rendering, face = np.nonzero(facing)
    corner = projected[rendering[:, None], meshes.faces[which[rendering], face]]
    triangle, column, row, inverse_there = _covered(corner, camera)
    outlines = _outlines(meshes, which, facing, points, projected, twists, camera)
    windows = Windows.of(outlines, len(which), camera)
    place = windows.places(rendering[triangle], column, row)
    areas = covered_areas(outlines, windows, np.bincount(place, minlength=len(windows)))
    return _nearest(windows, place, face[triangle], inverse_there, *areas, camera.width)


def _facing(
    meshes: MeshSet, which: NDArray[np.int64], camera_from_object: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Triangles (B, F + 1) whose outside is turned to the camera; the last one is none."""
    rotation, shift = camera_from_object[:, :3, :3], camera_from_object[:, :3, 3]
    centre = -np.einsum("bji,bj->bi", rotation, shift)
    facing = np.zeros((len(which), meshes.faces.shape[1] + 1), np.bool_)
    height = (meshes.normals[which] @ centre[:, :, None])[..., 0]
    np.greater(height, meshes.offsets[which], out=facing[:, :-1])
    return facing


def _outlines(
    meshes: MeshSet,
    which: NDArray[np.int64],
    facing: NDArray[np.bool_],
    points: NDArray[np.float64],
    projected: NDArray[np.float64],
    twists: NDArray[np.float64],
    camera: CameraIntrinsics,
) -> Outlines:
    """Edges between a triangle that faces the camera and one that does not."""
    thing = np.arange(len(which))[:, None]
    sides, turned = meshes.sides[which], facing.astype(np.int8)
    sign = turned[thing, sides[..., 0]] - turned[thing, sides[..., 1]]
    owner, edge = np.nonzero(sign)
    at = owner[:, None], meshes.ends[which[owner], edge]
    return Outlines(
        rendering=owner,
        ends=projected[at][..., :2],
        sign=sign[owner, edge].astype(np.float64),
        velocity=image_velocities(points[at], projected[at][..., 2], twists[owner], camera),
    )


def image_velocities(
    points_m: NDArray[np.float64],
    inverse: NDArray[np.float64],
    twists: NDArray[np.float64],
    camera: CameraIntrinsics,
) -> NDArray[np.float64]:
    """Pixels per unit of each motion, (S, N, K, 2), of N points of each of S things.

    Args:
        points_m: (S, N, 3) in the camera's frame.
        inverse: (S, N) of their depths.
        twists: (S, K, 6) velocity of the camera's origin and angular velocity.
        camera: of the image.
    """
    x, y, z = np.moveaxis(points_m[:, :, None], -1, 0)
    right, down, away, tilt, pan, roll = np.moveaxis(twists[:, None], -1, 0)
    inverse = inverse[..., None]
    away = (away + tilt * y - pan * x) * inverse
    across = camera.fx * inverse * (right + pan * z - roll * y - x * away)
    return np.stack([across, camera.fy * inverse * (down + roll * x - tilt * z - y * away)], axis=-1)


def _covered(
    corner: NDArray[np.float64], camera: CameraIntrinsics
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Triangle, column, row and inverse depth of every pixel centre within one of the triangles (T, 3, 3)."""
    x, y = corner[:, :, 0], corner[:, :, 1]
    total = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    low = np.maximum(np.ceil(corner[..., :2].min(axis=1)), 0).astype(np.int32)
    high = np.minimum(np.floor(corner[..., :2].max(axis=1)), [camera.width - 1, camera.height - 1])
    size = np.maximum(high.astype(np.int32) - low + 1, 0)
    size[total == 0] = 0  # seen on edge
    count = size.prod(axis=1)
    which = np.repeat(np.arange(len(count)), count)
    place = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    down, across = np.divmod(place, np.repeat(size[:, 0], count))
    column, row = across + np.repeat(low[:, 0], count), down + np.repeat(low[:, 1], count)
    inside = np.ones(len(which), np.bool_)
    planes = _planes(corner, np.where(total == 0, 1.0, total))
    for slope, fall, level in planes[:3]:
        inside &= slope[which] * column + fall[which] * row + level[which] >= 0
    which, column, row = which[inside], column[inside], row[inside]
    slope, fall, level = planes[3]
    inverse = slope[which] * column + fall[which] * row + level[which]
    return which, column, row, inverse


def _planes(corner: NDArray[np.float64], total: NDArray[np.float64]) -> list[list[NDArray[np.float64]]]:
    """Slopes, falls and levels (K,) over the image of each corner's share, and of the inverse depth."""
    x, y = corner[:, :, 0], corner[:, :, 1]
    shares = []
    for one in range(3):
        two, three = (one + 1) % 3, (one + 2) % 3
        slope, fall = -(y[:, three] - y[:, two]) / total, (x[:, three] - x[:, two]) / total
        shares.append([slope, fall, -(slope * x[:, two] + fall * y[:, two])])
    inverse = [sum(share[part] * corner[:, one, 2] for one, share in enumerate(shares)) for part in range(3)]
    return [*shares, [np.asarray(part) for part in inverse]]


def _nearest(
    windows: Windows,
    place: NDArray[np.int64],
    face: NDArray[np.int64],
    inverse: NDArray[np.float64],
    fill: NDArray[np.float64],
    change: NDArray[np.float64],
    image_width: int,
) -> Fragments:
    """Of all triangles over a pixel the nearest; pixels at an outline take their neighbour's."""
    nearest = np.zeros(len(fill))
    np.maximum.at(nearest, place, inverse)
    front = np.flatnonzero(inverse == nearest[place])
    shown = np.zeros(len(fill), np.int64)
    shown[place[front]] = face[front]
    filled = np.flatnonzero((fill > LEAST_FILL) | (nearest > 0))
    is_bare = nearest[filled] == 0
    source = filled.copy()
    source[is_bare] = _lenders(windows, filled[is_bare], nearest)
    lent = nearest[source] > 0
    filled, source = filled[lent], source[lent]
    start = np.searchsorted(filled, np.arange(len(windows.first) + 1) * (windows.height * windows.width))
    depth = (1.0 / nearest[source]).astype(np.float32)
    fill = np.maximum(fill[filled], LEAST_FILL)
    pixel, source_pixel = (
        row * image_width + column for column, row in map(windows.pixels, (filled, source))
    )
    return Fragments(start, pixel, depth, shown[source], source_pixel, fill, change[filled])


def _lenders(windows: Windows, bare: NDArray[np.int64], nearest: NDArray[np.float64]) -> NDArray[np.int64]:
    """A neighbour of each of these pixels that is covered; the pixel itself where none is."""
    line, column = np.divmod(bare, windows.width)
    row = line % windows.height
    lender = bare.copy()
    for down, right in reversed(NEIGHBOURS):
        inside = (row + down >= 0) & (row + down < windows.height)
        inside &= (column + right >= 0) & (column + right < windows.width)
        other = np.where(inside, bare + down * windows.width + right, bare)
        lender = np.where(nearest[other] > 0, other, lender)
    return lender


def _ranks(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many equal keys stand before each."""
    order = np.argsort(keys, kind="stable")
    place = np.arange(len(keys))
    first = np.append(True, np.diff(keys[order]) != 0)
    ranks = np.empty(len(keys), np.int64)
    ranks[order] = place - np.maximum.accumulate(np.where(first, place, 0))
    return ranks
