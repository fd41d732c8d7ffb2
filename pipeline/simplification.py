"""Meshes with as few triangles as their use needs."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

MOST_TRIANGLES = 400
"""Of a shape that is searched for in a small image: triangles of a centimetre, under its pixels."""


def few_triangles(
    vertices_m: NDArray[np.floating], faces: NDArray[np.integer], most: int = MOST_TRIANGLES
) -> trimesh.Trimesh:
    """The surface (V, 3), (F, 3) with so many triangles at most, by quadric decimation.

    Garland and Heckbert 1997.
    """
    import open3d as o3d

    if len(faces) <= most:
        return trimesh.Trimesh(vertices_m, faces, process=False)
    full = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(np.array(vertices_m, np.float64)),
        o3d.utility.Vector3iVector(np.array(faces, np.int32)),
    )
    fewer = full.simplify_quadric_decimation(most)
    return trimesh.Trimesh(np.asarray(fewer.vertices), np.asarray(fewer.triangles), process=False)
