"""Exports a run: the room and the objects in it, in the run's reference frame, in metres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.export.bop import bop_numbers
from pipeline.export.files import write_files
from pipeline.export.meshes import Geometry, Unseen, glb_bytes, mesh_bytes, moved, shape_mesh
from pipeline.export.model_export import SIMULATORS, ExportOptions, export_models
from pipeline.export.models import ExportModel, learned_model, looked_for_models
from pipeline.publishing.bop_poses import bop_lines
from pipeline.publishing.values import RunValues
from pipeline.run_folder import RunFolder

SCENE_FORMATS = ("ply", "glb")
"""Formats of the room with the objects where they stand; the others have the objects one by one."""
ROOM = "room"
POSES = "bop/poses.csv"
FRAME = "the run's reference frame: the camera of the first depth frame used, z forward, x right, y down"
MISSING = {
    "scene": "holds neither a room nor objects; make them with voxscene slam, learn or parse",
    "shapes": "holds no learned shapes; make them with voxscene learn",
    "objects": "holds no objects; make them with voxscene learn or parse",
}
"""What is said of a run that lacks what a format holds."""


def export_run(
    run: Path,
    formats: Sequence[str],
    out: Path,
    options: ExportOptions,
    room: trimesh.Trimesh | None = None,
) -> list[Path]:
    """Write room.ply and OBJECT.ply, everything as scene.glb, and its objects one by one in other formats.

    Args:
        run: run folder.
        formats: of `MODEL_FORMATS` of model_export.
        out: folder.
        options: how the objects are written one by one.
        room: triangles of the room, instead of the run's points.

    Returns:
        The files written, the manifest last.

    Raises:
        PipelineError: the run lacks what a format holds, or a file is there that says something else.
    """
    values = RunValues.load(RunFolder(run, force=False))
    posed = _posed_objects(values, options.unseen)
    geometry: Geometry | None = room if room is not None else _points(values)
    held = _held_parts(values, geometry)
    for form in formats:
        if _part(form) not in held:
            raise PipelineError(f"--format {form}: {run} {MISSING[_part(form)]}")
    if geometry is not None and ROOM in posed and not set(formats).isdisjoint(SCENE_FORMATS):
        raise PipelineError(
            f"{run} has an object named {ROOM}, as the room itself is: export that object alone, with"
            f" voxscene export {run}/shapes/{ROOM}.npz, and the run without {' and '.join(SCENE_FORMATS)}"
        )
    one_by_one = [form for form in formats if form not in SCENE_FORMATS]
    if not set(one_by_one) <= {"npz"}:
        _check_names(run, values)
    contents: dict[str, bytes] = {}
    if "ply" in formats:
        if geometry is not None:
            contents[f"{ROOM}.ply"] = mesh_bytes(geometry, "ply")
        for name, (mesh, pose) in posed.items():
            contents[f"{name}.ply"] = mesh_bytes(moved(mesh, pose), "ply")
    if "glb" in formats:
        parts = dict(posed) if geometry is None else {ROOM: (geometry, np.eye(4)), **posed}
        contents["scene.glb"] = glb_bytes(parts, values.up)
    models = _models(run, values, options, closed=not SIMULATORS.isdisjoint(one_by_one)) if one_by_one else []
    files = [{"format": Path(name).suffix[1:], "units": "m", "file": name} for name in contents]
    entry = {run.resolve().name: {"frame": FRAME, "files": files}}
    paths = write_files(out, contents, "runs", entry, force=options.force) if contents else []
    if not one_by_one:
        return paths
    poses: dict[str, bytes] = {}
    if "bop" in one_by_one:
        ids = bop_numbers([model.name for model in models], out, options.ids, _own_ids(values))
        options, poses = replace(options, ids=ids), _poses(values, models, ids)
    written = export_models(models, one_by_one, out, options, poses)
    return list(dict.fromkeys([*paths[:-1], *written]))


def held_formats(run: Path, formats: Sequence[str]) -> list[str]:
    """Those of the formats for which the run holds something."""
    values = RunValues.load(RunFolder(run, force=False))
    held = _held_parts(values, _points(values))
    return [form for form in formats if _part(form) in held]


def _held_parts(values: RunValues, geometry: Geometry | None) -> set[str]:
    """What there is of a run whose room is that geometry, as `MISSING` names it."""
    found = values.scene is not None and len(values.scene.found_poses) > 0
    parts = {
        "scene": geometry is not None or bool(values.shapes) or found,
        "shapes": bool(values.shapes),
        "objects": bool(values.shapes or (values.surfaces and values.surfaces.by_name)),
    }
    return {part for part, is_there in parts.items() if is_there}


def _part(form: str) -> str:
    """What of a run a format holds, as `MISSING` names it."""
    return "scene" if form in SCENE_FORMATS else "shapes" if form == "npz" else "objects"


def _models(run: Path, values: RunValues, options: ExportOptions, *, closed: bool) -> list[ExportModel]:
    """The run's learned shapes, and what its parse looked for."""
    folder = RunFolder(run, force=False)
    learned = [
        learned_model(folder.value_path(f"learn/{name}"), shells=options.shells, unseen=options.unseen)
        for name in values.shapes
    ]
    names = {model.name for model in learned}
    return learned + [model for model in looked_for_models(values, closed=closed) if model.name not in names]


def _check_names(run: Path, values: RunValues) -> None:
    """Refuse a learned shape and another one of its name that parse looked for, of whose frame poses are.

    Raises:
        PipelineError: there are two such shapes.
    """
    for name, shape in values.shapes.items():
        looked_for = values.surfaces.by_name.get(name) if values.surfaces else None
        if looked_for and not np.array_equal(shape.surface().vertices_m, looked_for.vertices_m):
            raise PipelineError(
                f"{run} has two shapes named {name}, one that was learned in it and another that parse looked"
                f" for: export the first with voxscene export {run}/shapes/{name}.npz, and parse into "
                "another folder for the second"
            )


def _own_ids(values: RunValues) -> dict[str, int]:
    """Ids of the shapes that the run's parse looked for."""
    return values.surfaces.object_ids if values.surfaces is not None else {}


def _poses(values: RunValues, models: Sequence[ExportModel], ids: Mapping[str, int]) -> dict[str, bytes]:
    """The poses of the models of BOP, by the same ids and in the same frames."""
    if values.scene is None or values.surfaces is None:
        return {}
    by_shape = {model.name: model.own_from_model("middle") for model in models}
    shapes = values.surfaces.shape_names
    own_from_model = {name: by_shape[shape] for name, shape in shapes.items()}
    numbers = {name: ids[shape] for name, shape in shapes.items()}
    return {POSES: bop_lines(values, own_from_model, numbers).encode()}


def _points(values: RunValues) -> trimesh.PointCloud | None:
    if values.room is None or not len(values.room.points_m):
        return None
    return trimesh.PointCloud(values.room.points_m.astype(np.float64), colors=values.room.rgb)


def _posed_objects(
    values: RunValues, unseen: Unseen
) -> dict[str, tuple[trimesh.Trimesh, NDArray[np.float64]]]:
    """Meshes of what was learned and of what was found, with their poses in the reference frame."""
    posed = {
        name: (shape_mesh(shape, name, unseen=unseen), shape.reference_from_grid)
        for name, shape in values.shapes.items()
    }
    scene = values.scene
    if scene is not None and values.surfaces is not None:
        for name, pose in scene.found_poses:
            surface = values.surfaces.by_name[str(name)]
            mesh = trimesh.Trimesh(
                surface.vertices_m, surface.faces, vertex_colors=surface.rgb, process=False
            )
            posed[str(name)] = (mesh, values.reference_from_parsed @ pose)
    return posed
