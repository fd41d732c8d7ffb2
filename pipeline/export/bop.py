"""Models as BOP keeps them: models/obj_NNNNNN.ply in millimetres, origin in the middle, models_info.json.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from pipeline.export.meshes import mesh_bytes, moved


def bop_models(
    meshes: Mapping[str, trimesh.Trimesh],
) -> tuple[dict[str, bytes], dict[str, Any], dict[str, dict[str, Any]]]:
    """Models of meshes in metres.

    Returns:
        Contents by path inside the BOP folder, models_info, and for every mesh its id, file and
        `object_from_bop`, which maps the model's coordinates in metres to the mesh's own.
    """
    files, info, entries = {}, {}, {}
    for number, (name, mesh) in enumerate(sorted(meshes.items()), start=1):
        middle, back = np.eye(4), np.eye(4)
        middle[:3, 3] = mesh.bounds.mean(axis=0)
        back[:3, 3] = -middle[:3, 3]
        model = moved(mesh, back, "mm")
        path = f"models/obj_{number:06d}.ply"
        files[path] = mesh_bytes(model, "ply")
        info[str(number)] = _model_info(np.asarray(model.vertices))
        entries[name] = {"id": number, "file": path, "object_from_bop": middle.tolist()}
    return files, info, entries


def _model_info(vertices_mm: NDArray[np.float64]) -> dict[str, float]:
    corners = vertices_mm[ConvexHull(vertices_mm).vertices]
    low, size = vertices_mm.min(axis=0), np.ptp(vertices_mm, axis=0)
    return {
        "diameter": float(pdist(corners).max()),
        **{f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)},
        **{f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)},
    }
