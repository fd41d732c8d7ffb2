"""Normals that change evenly over a surface of triangles, but for its creases (Gouraud 1971)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shapes.rendering.meshes import Mesh

CREASE = np.cos(np.radians(40.0))
"""Cosine between triangles from which they are one smooth surface: a ball of 400 triangles bends by 20
degrees from one to the next, a box by 90."""
LEAST_AREA = 1e-15
"""Square metres, of a triangle that has a normal."""


def smooth_normals(mesh: Mesh) -> NDArray[np.float64]:
    """Unit normals (F, 3, 3) at corners: of all triangles round the point that bend little, by areas."""
    area = np.linalg.norm(mesh.normals, axis=1, keepdims=True)
    unit = mesh.normals / np.maximum(area, LEAST_AREA)
    _, point = np.unique(mesh.vertices_m, axis=0, return_inverse=True)
    corner = point.ravel()[mesh.faces].ravel()
    order = np.argsort(corner, kind="stable")
    start = np.searchsorted(corner[order], np.arange(corner.max() + 2))
    count = np.diff(start)[corner]
    mine = np.repeat(np.arange(len(corner)), count)
    place = np.arange(len(mine)) - np.repeat(np.cumsum(count) - count, count)
    other = order[start[corner[mine]] + place] // 3
    alike = (unit[mine // 3] * unit[other]).sum(axis=1) > CREASE
    total = np.zeros((len(corner), 3))
    np.add.at(total, mine[alike], mesh.normals[other[alike]])
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals = np.where(
        length > LEAST_AREA, total / np.maximum(length, LEAST_AREA), np.repeat(unit, 3, axis=0)
    )
    return normals.reshape(-1, 3, 3)


def normal_fields(
    mesh: Mesh, corner_normals: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Normals, not of length 1, at points x of each triangle: `level + slope @ x`, (F, 3) and (F, 3, 3)."""
    origin, one, two = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
    normal = mesh.normals
    size = (normal**2).sum(axis=1, keepdims=True)
    whole = size > LEAST_AREA**2
    first = np.cross(two - origin, normal) / np.where(whole, size, 1.0)
    second = np.cross(normal, one - origin) / np.where(whole, size, 1.0)
    change = corner_normals[:, 1:] - corner_normals[:, :1]
    slope = change[:, 0, :, None] * first[:, None] + change[:, 1, :, None] * second[:, None]
    slope = np.where(whole[..., None], slope, 0.0)
    return corner_normals[:, 0] - np.einsum("fij,fj->fi", slope, origin), slope
