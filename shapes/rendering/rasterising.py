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
    depth = np.maximum(points[..., 2], NEAREST_M)
    projected = np.stack(
        [
            camera.fx * points[..., 0] / depth + camera.cx,
            camera.fy * points[..., 1] / depth + camera.cy,
            1 / depth,
        ],
        axis=-1,
    )
    rendering, face = np.nonzero(_facing(vertices_m, faces, camera_from_object))
    corner = projected[rendering[:, None], faces[face]]
    whole = (corner[:, :, 2] < 1 / NEAREST_M).all(axis=1)
    rendering, face, corner = rendering[whole], face[whole], corner[whole]
    triangle, pixel, inverse = _covered(corner, camera)
    return _nearest(rendering[triangle], face[triangle], pixel, inverse, len(points), camera)


def _facing(
    vertices_m: NDArray[np.float64], faces: NDArray[np.int64], camera_from_object: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Triangles (B, F) whose outside is turned to the camera."""
    corner = vertices_m[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    rotation, shift = camera_from_object[:, :3, :3], camera_from_object[:, :3, 3]
    centre = -np.einsum("bji,bj->bi", rotation, shift)
    return centre @ normal.T > (normal * corner[:, 0]).sum(axis=1)


def _covered(
    corner: NDArray[np.float64], camera: CameraIntrinsics
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Triangle, pixel and inverse depth of every pixel centre within one of the triangles (K, 3, 3)."""
    x, y = corner[:, :, 0], corner[:, :, 1]
    total = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0])
    low = np.maximum(np.ceil(corner[..., :2].min(axis=1)), 0).astype(np.int64)
    high = np.minimum(np.floor(corner[..., :2].max(axis=1)), [camera.width - 1, camera.height - 1])
    size = np.maximum(high.astype(np.int64) - low + 1, 0)
    size[total == 0] = 0  # seen on edge
    count = size.prod(axis=1)
    which = np.repeat(np.arange(len(count)), count)
    place = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    column = low[which, 0] + place % size[which, 0]
    row = low[which, 1] + place // size[which, 0]
    total = np.where(total == 0, 1.0, total)
    inside = np.ones(len(which), np.bool_)
    inverse = np.zeros(len(which))
    for one in range(3):
        two, three = (one + 1) % 3, (one + 2) % 3
        across, down = (x[:, three] - x[:, two]) / total, (y[:, three] - y[:, two]) / total
        share = across[which] * (row - y[which, two]) - down[which] * (column - x[which, two])
        inside &= share >= 0
        inverse += share * corner[which, one, 2]
    return which[inside], (row * camera.width + column)[inside], inverse[inside]


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
    order = np.lexsort((-inverse, place))
    kept = order[np.diff(place[order], prepend=-1) > 0]
    start = np.searchsorted(rendering[kept], np.arange(renderings + 1))
    return Fragments(start, pixel[kept], (1.0 / inverse[kept]).astype(np.float32), face[kept])
