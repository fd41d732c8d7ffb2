"""Exports a run: the fused room and the objects in it, in the run's reference frame, in metres."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

from pipeline.errors import PipelineError
from pipeline.export.meshes import mesh_bytes, moved, shape_mesh
from pipeline.export.shape_export import write_files
from pipeline.publishing.values import RunValues
from pipeline.run_folder import RunFolder

RUN_FORMATS = ("ply", "glb")
FRAME = "the run's reference frame: the camera of its first depth frame, z forward, x right, y down"


def export_run(run: Path, formats: Sequence[str], out: Path) -> list[Path]:
    """Write room.ply and OBJECT.ply, or everything as scene.glb; and manifest.json.

    Args:
        run: run folder.
        formats: of `RUN_FORMATS`.
        out: folder.

    Returns:
        The files written, the manifest last.

    Raises:
        PipelineError: the run holds nothing to export.
    """
    values = RunValues.load(RunFolder(run, force=False))
    objects = {**_learned(values), **_parsed(values)}
    cloud = _room(values)
    if cloud is None and not objects:
        raise PipelineError(f"{run} holds neither a room nor objects; make them with slam, learn or parse")
    contents: dict[str, bytes] = {}
    if "ply" in formats:
        if cloud is not None:
            contents["room.ply"] = mesh_bytes(cloud, "ply")
        contents |= {f"{name}.ply": mesh_bytes(mesh, "ply") for name, mesh in objects.items()}
    if "glb" in formats:
        scene = trimesh.Scene()
        if cloud is not None:
            scene.add_geometry(cloud, node_name="room", geom_name="room")
        for name, mesh in objects.items():
            scene.add_geometry(mesh, node_name=name, geom_name=name)
        contents["scene.glb"] = mesh_bytes(scene, "glb")
    files = [{"file": name, "units": "m"} for name in contents]
    return write_files(out, contents, {"format_version": 1, "frame": FRAME, "files": files})


def _room(values: RunValues) -> trimesh.PointCloud | None:
    if values.room is None or not len(values.room.points_m):
        return None
    return trimesh.PointCloud(values.room.points_m.astype(np.float64), colors=values.room.rgb)


def _learned(values: RunValues) -> dict[str, trimesh.Trimesh]:
    return {
        name: moved(shape_mesh(shape, name), shape.reference_from_grid)
        for name, shape in values.shapes.items()
    }


def _parsed(values: RunValues) -> dict[str, trimesh.Trimesh]:
    """Objects that were found, posed in the reference frame."""
    scene = values.scene
    if scene is None or values.surfaces is None:
        return {}
    objects: dict[str, trimesh.Trimesh] = {}
    for name, pose in scene.found_poses:
        surface = values.surfaces.by_name[str(name)]
        mesh = trimesh.Trimesh(surface.vertices_m, surface.faces, process=False)
        objects[str(name)] = moved(mesh, values.reference_from_parsed @ pose)
    return objects
