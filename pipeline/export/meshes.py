"""Surfaces of learned shapes as meshes for others: closed, wound outward, in the units asked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.errors import PipelineError
from pipeline.meshes import Units
from shapes.prior import ShapePrior
from shapes.surface import SurfaceMesh

PER_METRE = {"m": 1.0, "mm": 1000.0}

Geometry = trimesh.Trimesh | trimesh.PointCloud


Unseen = Literal["fill", "open"]
"""What a learned shape's surface does where nothing was seen: close behind it, or end there."""


def shape_mesh(
    shape: ShapePrior, name: str, level: float = 0.5, *, unseen: Unseen = "fill"
) -> trimesh.Trimesh:
    """Surface of a shape in metres in its grid frame, enclosed voxels filled or the surface left open there.

    Raises:
        PipelineError: no voxel lies above the level, or the surface is not closed and outward.
    """
    try:
        surface = shape.surface(level)
    except ValueError as error:
        raise PipelineError(f"{name}: {error}") from error
    if unseen == "open":
        return as_trimesh(shape.seen_part(surface))
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
        raise PipelineError(
            f"the surface of {name} is not closed and outward, and bounds no volume: mend it, or write stl"
        )
    return mesh


def moved(
    mesh: trimesh.Trimesh, target_from_mesh: NDArray[np.float64], units: Units = "m"
) -> trimesh.Trimesh:
    """A copy in another frame (4, 4, metres) and in other units."""
    copy = mesh.copy()
    copy.apply_transform(target_from_mesh)
    copy.apply_scale(PER_METRE[units])
    return copy


def mean_colour(mesh: trimesh.Trimesh) -> tuple[float, float, float] | None:
    """Mean colour of a mesh's vertices, 0 to 1; None where they have none."""
    visual: Any = mesh.visual
    if getattr(visual, "kind", None) != "vertex":
        return None
    red, green, blue = (np.asarray(visual.vertex_colors)[:, :3].mean(axis=0) / 255).tolist()
    return red, green, blue


def mesh_bytes(mesh: Geometry, file_type: str) -> bytes:
    """A mesh as the content of a ply, obj or stl file, with vertex normals where the format has them."""
    options: dict[str, Any] = {}
    if isinstance(mesh, trimesh.Trimesh):
        options = {"ply": {"vertex_normal": True}, "obj": {"include_normals": True}}.get(file_type, {})
    content: Any = mesh.export(file_type=file_type, **options)
    return content.encode() if isinstance(content, str) else bytes(content)


def glb_bytes(parts: Mapping[str, tuple[Geometry, NDArray[np.float64]]], up: NDArray[np.float64]) -> bytes:
    """A binary glTF scene, whose y axis is up, with a named node for each part.

    Args:
        parts: by name, a geometry in metres in its own frame and its pose (4, 4) in a common frame.
        up: unit vector (3,) that points up in the common frame.
    """
    scene = trimesh.Scene()
    for name, (geometry, pose) in parts.items():
        scene.add_geometry(geometry, node_name=name, geom_name=name, transform=_y_up(up) @ pose)
    content: Any = scene.export(file_type="glb", include_normals=True)
    return bytes(content)


def _y_up(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation (4, 4) that turns a direction to +y about the axis across both."""
    rotation = np.eye(4)
    rotation[:3, :3] = Rotation.align_vectors([0.0, 1.0, 0.0], up)[0].as_matrix()
    return rotation
