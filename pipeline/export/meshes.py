"""Surfaces of learned shapes as meshes for others: closed, wound outward, in the units asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.meshes import Units
from shapes.prior import ShapePrior
from shapes.surface import SurfaceMesh

PER_METRE = {"m": 1.0, "mm": 1000.0}


def shape_mesh(shape: ShapePrior, name: str, level: float = 0.5) -> trimesh.Trimesh:
    """Surface of a shape in metres in its grid frame, enclosed voxels filled.

    Raises:
        PipelineError: no voxel lies above the level, or the surface is not closed and outward.
    """
    try:
        surface = shape.surface(level)
    except ValueError as error:
        raise PipelineError(f"{name}: {error}") from error
    return checked(as_trimesh(surface), name)


def as_trimesh(surface: SurfaceMesh) -> trimesh.Trimesh:
    """The same triangles, with colours where there are some."""
    return trimesh.Trimesh(surface.vertices_m, surface.triangles, vertex_colors=surface.rgb, process=False)


def checked(mesh: trimesh.Trimesh, name: str) -> trimesh.Trimesh:
    """The mesh itself if it bounds a volume.

    Raises:
        PipelineError: it has holes, or faces that look inward.
    """
    if not (mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0):
        raise PipelineError(f"the surface of {name} is not closed and outward, so it is not written")
    return mesh


def moved(
    mesh: trimesh.Trimesh, target_from_mesh: NDArray[np.float64], units: Units = "m"
) -> trimesh.Trimesh:
    """A copy in another frame (4, 4, metres) and in other units."""
    copy = mesh.copy()
    copy.apply_transform(target_from_mesh)
    copy.apply_scale(PER_METRE[units])
    return copy


def mesh_bytes(mesh: trimesh.Trimesh | trimesh.PointCloud | trimesh.Scene, file_type: str) -> bytes:
    """A mesh as a file's content."""
    content: Any = mesh.export(file_type=file_type)
    return content.encode() if isinstance(content, str) else bytes(content)
