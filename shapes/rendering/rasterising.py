"""Rasterised triangle meshes at many poses at once: the pixels that each covers, for small images.

Exact at pixel centres for any closed mesh, with the triangle that is seen there; cost grows with covered
pixels, not with the image. NumPy alone, for renderings that are made once and kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recordings.types import CameraIntrinsics

NEAREST_M = 1e-3
"""Triangles that reach nearer to the camera than this are not seen."""


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
    vertices_m: NDArray[np.float64],
    faces: NDArray[np.int64],
    camera_from_object: NDArray[np.float64],
    camera: CameraIntrinsics,
) -> Fragments:
    """What is seen of a closed mesh at B poses, each alone.

    Args:
        vertices_m: (V, 3).
        faces: (F, 3), counter-clockwise from outside.
        camera_from_object: (B, 4, 4) rigid.
        camera: of the image.
    """
    rotation, shift = camera_from_object[:, :3, :3], camera_from_object[:, None, :3, 3]
    points = vertices_m @ rotation.swapaxes(1, 2) + shift
    depth = points[..., 2]
    safe = np.maximum(depth, NEAREST_M)
    column = camera.fx * points[..., 0] / safe + camera.cx
    row = camera.fy * points[..., 1] / safe + camera.cy
    corner = np.stack([column, row, 1.0 / safe], axis=-1)[:, faces]  # (B, F, 3, 3)
    near = (depth < NEAREST_M)[:, faces].any(axis=2)
    first, second = corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0]
    area = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    low = np.maximum(np.ceil(corner[..., :2].min(axis=2)), 0).astype(np.int64)
    high = np.minimum(np.floor(corner[..., :2].max(axis=2)), [camera.width - 1, camera.height - 1])
    size = np.maximum(high.astype(np.int64) - low + 1, 0)
    size[(area >= 0) | near] = 0  # rows point down: the front of a triangle winds the other way
    return _nearest(_covered(corner, area, low, size), len(points), camera)


def _covered(
    corner: NDArray[np.float64],
    area: NDArray[np.float64],
    low: NDArray[np.int64],
    size: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Rendering, triangle, column, row and inverse depth of every pixel centre within a triangle."""
    count = size.prod(axis=2)
    rendering, face = np.nonzero(count)
    count = count[rendering, face]
    which = np.repeat(np.arange(len(count)), count)
    place = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    width = size[rendering, face, 0][which]
    column = low[rendering, face, 0][which] + place % width
    row = low[rendering, face, 1][which] + place // width
    triangle = corner[rendering, face]
    total = area[rendering, face]
    x, y = triangle[:, :, 0], triangle[:, :, 1]
    inside = np.ones(len(which), np.bool_)
    inverse = np.zeros(len(which))
    for one in range(3):
        two, three = (one + 1) % 3, (one + 2) % 3
        across, down = (x[:, three] - x[:, two]) / total, (y[:, three] - y[:, two]) / total
        share = across[which] * (row - y[:, two][which]) - down[which] * (column - x[:, two][which])
        inside &= share >= 0
        inverse += share * triangle[:, one, 2][which]
    return rendering[which[inside]], face[which[inside]], column[inside], row[inside], inverse[inside]


def _nearest(
    covered: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray],
    renderings: int,
    camera: CameraIntrinsics,
) -> Fragments:
    """Of all triangles over a pixel the one before the others."""
    rendering, face, column, row, inverse = covered
    pixels = camera.width * camera.height
    place = rendering * pixels + row * camera.width + column
    order = np.lexsort((-inverse, place))
    kept = order[np.diff(place[order], prepend=-1) > 0]
    start = np.searchsorted(rendering[kept], np.arange(renderings + 1))
    depth = (1.0 / inverse[kept]).astype(np.float32)
    return Fragments(start, place[kept] % pixels, depth, face[kept])
