"""Rasterised triangle meshes at many poses at once: the pixels that each covers, for small images.

Exact at pixel centres for any closed mesh, with the triangle that is seen there; cost grows with covered
pixels, not with the image. NumPy alone, for renderings that are made once and kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics

NEAREST_M = 1e-3
"""Triangles that reach nearer to the camera than this are not seen."""


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


@dataclass(frozen=True, eq=False)
class Fragments:
    """Pixels covered by each of B renderings; those of rendering b are rows `start[b]` to `start[b + 1]`.

    Attributes:
        start: (B + 1,) int64.
        pixel: (P,) int64, row * width + column, ascending within a rendering.
        depth_m: (P,) float32 along the optical axis.
        face: (P,) int64 triangle that is seen.
    """

    start: NDArray[np.int64]
    pixel: NDArray[np.int64]
    depth_m: NDArray[np.float32]
    face: NDArray[np.int64]


def rasterise(
    meshes: Sequence[Mesh],
    which: NDArray[np.int64],
    camera_from_object: NDArray[np.float64],
    camera: CameraIntrinsics,
) -> Fragments:
    """What is seen of closed meshes at B poses, each alone.

    Args:
        meshes: that may be seen.
        which: (B,) number of each one's mesh.
        camera_from_object: (B, 4, 4) rigid.
        camera: of the image.
    """
    parts = [
        _triangles(meshes[one], camera_from_object, np.flatnonzero(which == one), camera)
        for one in np.unique(which)
    ]
    if not parts:
        nothing = np.zeros(0, np.int64)
        return Fragments(np.zeros(1, np.int64), nothing, np.zeros(0, np.float32), nothing)
    rendering, face, corner = (np.concatenate(part) for part in zip(*parts, strict=True))
    triangle, pixel, inverse = _covered(corner, camera)
    return _nearest(rendering[triangle], face[triangle], pixel, inverse, len(which), camera)


def _triangles(
    mesh: Mesh,
    camera_from_object: NDArray[np.float64],
    which: NDArray[np.int64],
    camera: CameraIntrinsics,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Rendering, face and corners (K, 3, 3), projected and with inverse depths, of one mesh's renderings."""
    poses = camera_from_object[which]
    points = mesh.vertices_m @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    depth = np.maximum(points[..., 2], NEAREST_M)
    projected = np.stack(
        [
            camera.fx * points[..., 0] / depth + camera.cx,
            camera.fy * points[..., 1] / depth + camera.cy,
            1 / depth,
        ],
        axis=-1,
    )
    rendering, face = np.nonzero(_facing(mesh, poses))
    corner = projected[rendering[:, None], mesh.faces[face]]
    whole = (corner[:, :, 2] < 1 / NEAREST_M).all(axis=1)
    return which[rendering[whole]], face[whole], corner[whole]


def _facing(mesh: Mesh, camera_from_object: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Triangles (B, F) whose outside is turned to the camera."""
    rotation, shift = camera_from_object[:, :3, :3], camera_from_object[:, :3, 3]
    centre = -np.einsum("bji,bj->bi", rotation, shift)
    return centre @ mesh.normals.T > mesh.offsets


def _covered(
    corner: NDArray[np.float64], camera: CameraIntrinsics
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Triangle, pixel and inverse depth of every pixel centre within one of the triangles (K, 3, 3)."""
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
    return which, row * camera.width + column, inverse


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
    rendering: NDArray[np.int64],
    face: NDArray[np.int64],
    pixel: NDArray[np.int64],
    inverse: NDArray[np.float64],
    renderings: int,
    camera: CameraIntrinsics,
) -> Fragments:
    """Of all triangles over a pixel the one before the others."""
    pixels = camera.width * camera.height
    place = rendering * pixels + pixel
    nearest = np.zeros(renderings * pixels)
    np.maximum.at(nearest, place, inverse)
    front = np.flatnonzero(inverse == nearest[place])
    shown = np.zeros(len(nearest), np.int64)
    shown[place[front]] = face[front]
    filled = np.flatnonzero(nearest)
    start = np.searchsorted(filled, np.arange(renderings + 1) * pixels)
    depth = (1.0 / nearest[filled]).astype(np.float32)
    return Fragments(start, filled % pixels, depth, shown[filled])
