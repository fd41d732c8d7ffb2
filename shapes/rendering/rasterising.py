"""Rasterised triangle meshes at many poses at once: the pixels that each covers, for small images.

Exact at pixel centres for any closed mesh, with the triangle that is seen there, and exact in the share of
each pixel's square that is filled; cost grows with covered pixels, not with the image. NumPy alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics
from shapes.rendering.meshes import MeshSet
from shapes.rendering.outlines import Outlines, Windows, covered_areas

NEAREST_M = 1e-3
"""Triangles that reach nearer to the camera than this are not seen."""
LEAST_FILL = 1e-3
"""Share of a pixel's square below which it is left out: a quarter of a step of 8 bits."""
NEIGHBOURS = ((0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
"""Rows and columns from a pixel whose centre is not covered to those that lend it their triangle."""


@dataclass(frozen=True, eq=False)
class Fragments:
    """Pixels covered by each of B renderings; those of rendering b are rows `start[b]` to `start[b + 1]`.

    What is seen of pixel p are samples `first[p]` to `first[p + 1]`; where none meets it a neighbour's.

    Attributes:
        start: (B + 1,) int64.
        pixel: (P,) int64, row * width + column, ascending within a rendering.
        depth_m: (P,) along the optical axis, harmonic mean of the samples.
        fill: (P,) share of the pixel's square that is covered.
        fill_change: (P, K) its rate of change under each of K motions.
        first: (P + 1,).
        column: (H,) of the samples, in pixels.
        row: (H,).
        sample_depth_m: (H,).
        face: (H,) triangle that is seen.
    """

    start: NDArray[np.int64]
    pixel: NDArray[np.int64]
    depth_m: NDArray[np.float64]
    fill: NDArray[np.float64]
    fill_change: NDArray[np.float64]
    first: NDArray[np.int64]
    column: NDArray[np.float64]
    row: NDArray[np.float64]
    sample_depth_m: NDArray[np.float64]
    face: NDArray[np.int64]


def rasterise(
    meshes: MeshSet,
    which: NDArray[np.int64],
    camera_from_object: NDArray[np.float64],
    camera: CameraIntrinsics,
    twists: NDArray[np.float64] | None = None,
    samples: int = 1,
) -> Fragments:
    """What is seen of closed meshes at B poses, each alone.

    Args:
        meshes: that may be seen.
        which: (B,) number of each one's mesh.
        camera_from_object: (B, 4, 4) rigid.
        camera: of the image.
        twists: (B, K, 6) motions of each, velocity of the camera's origin and angular velocity.
        samples: along each side of a pixel.
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
    corner[..., :2] = (corner[..., :2] + 0.5) * samples - 0.5
    triangle, column, row, inverse_there = _covered(corner, camera.width * samples, camera.height * samples)
    outlines = _outlines(meshes, which, facing, points, projected, twists, camera)
    windows = Windows.of(outlines, len(which), camera)
    fine = Windows(windows.first * samples, windows.width * samples, windows.height * samples)
    place = fine.places(rendering[triangle], column, row)
    windings = np.bincount(place, minlength=len(fine)).reshape(-1, fine.height, fine.width)
    windings = windings[:, ::samples, ::samples].ravel()
    fill, change = covered_areas(outlines, windows, windings, 0.5 / samples)
    return _nearest(windows, fine, place, face[triangle], inverse_there, fill, change, camera.width)


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
    corner: NDArray[np.float64], width: int, height: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Triangle, column, row and inverse depth of every pixel centre within one of the triangles (T, 3, 3)."""
    x, y = corner[:, :, 0], corner[:, :, 1]
    total = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    low = np.maximum(np.ceil(corner[..., :2].min(axis=1)), 0).astype(np.int32)
    high = np.minimum(np.floor(corner[..., :2].max(axis=1)), [width - 1, height - 1])
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
    fine: Windows,
    place: NDArray[np.int64],
    face: NDArray[np.int64],
    inverse: NDArray[np.float64],
    fill: NDArray[np.float64],
    change: NDArray[np.float64],
    image_width: int,
) -> Fragments:
    """Of all triangles over a sample the nearest, pixel by pixel.

    Args:
        windows: of the renderings.
        fine: the same, of samples.
        place: (H,) samples, through all fine windows, under triangles.
        face: (H,) these triangles.
        inverse: (H,) of their depths.
        fill: (len(windows),).
        change: (len(windows), K).
        image_width: in pixels.
    """
    samples = fine.width // windows.width
    nearest, shown = np.zeros(len(fine)), np.zeros(len(fine), np.int64)
    np.maximum.at(nearest, place, inverse)
    front = np.flatnonzero(inverse == nearest[place])
    shown[place[front]] = face[front]
    met = np.flatnonzero(nearest)
    line, column = np.divmod(met, fine.width)
    pixel = line // samples * windows.width + column // samples
    if samples > 1:
        order = np.argsort(pixel, kind="stable")
        met, pixel = met[order], pixel[order]
    count = np.bincount(pixel, minlength=len(windows))
    filled = np.flatnonzero((fill > LEAST_FILL) | (count > 0))
    source, is_bare = filled.copy(), count[filled] == 0
    source[is_bare] = _lenders(windows, filled[is_bare], count)
    filled, source = (one[count[source] > 0] for one in (filled, source))
    seen = count[source]
    first = np.append(0, np.cumsum(seen))
    rank = np.arange(first[-1]) - np.repeat(first[:-1], seen)
    met = met[np.repeat((np.cumsum(count) - count)[source], seen) + rank]
    column, row = fine.pixels(met)
    depth = 1 / nearest[met]
    own_column, own_row = windows.pixels(filled)
    return Fragments(
        start=np.searchsorted(filled, np.arange(len(windows.first) + 1) * (windows.height * windows.width)),
        pixel=own_row * image_width + own_column,
        depth_m=seen / np.add.reduceat(nearest[met], first[:-1]) if len(seen) else np.zeros(0),
        fill=np.maximum(fill[filled], LEAST_FILL),
        fill_change=change[filled],
        first=first,
        column=(column + 0.5) / samples - 0.5,
        row=(row + 0.5) / samples - 0.5,
        sample_depth_m=depth,
        face=shown[met],
    )


def _lenders(windows: Windows, bare: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.int64]:
    """A neighbour of each of these pixels in which something is met; the pixel itself where none has."""
    line, column = np.divmod(bare, windows.width)
    row = line % windows.height
    lender = bare.copy()
    for down, right in reversed(NEIGHBOURS):
        inside = (row + down >= 0) & (row + down < windows.height)
        inside &= (column + right >= 0) & (column + right < windows.width)
        other = np.where(inside, bare + down * windows.width + right, bare)
        lender = np.where(count[other] > 0, other, lender)
    return lender
