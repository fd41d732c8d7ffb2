"""A renderer of triangles that shares nothing with the program's: a z-buffer over pixel centres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh

from recordings.types import CameraIntrinsics


def z_buffer(
    meshes: Sequence[tuple[trimesh.Trimesh, np.ndarray]], intrinsics: CameraIntrinsics
) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W), infinite where nothing is, and the index of the mesh seen there, -1 where none.

    Args:
        meshes: each with its pose (4, 4) in the camera's frame, wholly before the camera.
        intrinsics: of the camera.
    """
    depth = np.full((intrinsics.height, intrinsics.width), np.inf)
    owner = np.full(depth.shape, -1)
    for index, (mesh, pose) in enumerate(meshes):
        points = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        u = intrinsics.fx * points[:, 0] / points[:, 2] + intrinsics.cx
        v = intrinsics.fy * points[:, 1] / points[:, 2] + intrinsics.cy
        for face in mesh.faces:
            _draw(depth, owner, index, u[face], v[face], points[face, 2])
    return depth, owner


def _draw(
    depth: np.ndarray, owner: np.ndarray, index: int, u: np.ndarray, v: np.ndarray, z: np.ndarray
) -> None:
    """One triangle; inverse depth is linear over the image."""
    area = (u[1] - u[0]) * (v[2] - v[0]) - (u[2] - u[0]) * (v[1] - v[0])
    columns = np.arange(max(int(np.ceil(u.min())), 0), min(int(np.floor(u.max())) + 1, depth.shape[1]))
    rows = np.arange(max(int(np.ceil(v.min())), 0), min(int(np.floor(v.max())) + 1, depth.shape[0]))
    if abs(area) < 1e-12 or not len(columns) or not len(rows):
        return
    x, y = np.meshgrid(columns, rows)
    first = ((u[1] - x) * (v[2] - y) - (u[2] - x) * (v[1] - y)) / area
    second = ((u[2] - x) * (v[0] - y) - (u[0] - x) * (v[2] - y)) / area
    third = 1 - first - second
    inside = (first >= 0) & (second >= 0) & (third >= 0)
    with np.errstate(divide="ignore"):
        here = 1 / (first / z[0] + second / z[1] + third / z[2])
    nearer = inside & (here < depth[y, x])
    depth[y[nearer], x[nearer]] = here[nearer]
    owner[y[nearer], x[nearer]] = index
