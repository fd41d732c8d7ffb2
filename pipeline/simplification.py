"""Meshes with as few triangles as their use needs."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

MOST_TRIANGLES = 600
"""Of a shape that is searched for in a small image: triangles of a centimetre, under its pixels."""
PRINTED = 12
"""Triangles along the longest edge of a shape whose colours are known: prints of a centimetre are seen."""


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


def few_coloured_triangles(
    vertices_m: NDArray[np.floating], faces: NDArray[np.integer], rgb: NDArray[np.uint8], gamma: float
) -> tuple[trimesh.Trimesh, NDArray[np.float64]]:
    """The same, cut where triangles are longer than a print, and the light (F, 3) in 0..1 that they return.

    Args:
        vertices_m: (V, 3).
        faces: (F, 3).
        rgb: (V, 3) of the vertices.
        gamma: exponent by which stored values become light.
    """
    from scene.objects.surface_colour import light_of_triangles

    few = few_triangles(vertices_m, faces)
    longest_m = float(np.ptp(few.bounds, axis=0).max()) / PRINTED
    cut = trimesh.remesh.subdivide_to_size(few.vertices, few.faces, longest_m)
    cut_mesh = trimesh.Trimesh(cut[0], cut[1], process=False)
    whole = trimesh.Trimesh(vertices_m, faces, process=False)
    return cut_mesh, light_of_triangles(cut_mesh, whole, rgb, gamma)
