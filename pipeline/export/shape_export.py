"""Exports one learned shape."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.atomic import atomic_path, write_json
from pipeline.errors import PipelineError
from pipeline.export.bop import bop_models
from pipeline.export.meshes import mesh_bytes, moved, shape_mesh
from pipeline.meshes import Units
from pipeline.shape_folder import usable
from shapes.prior import ShapePrior

SHAPE_FORMATS = ("npz", "ply", "obj", "glb", "stl", "bop")
SHELLS = (0.1, 0.9)
FRAME = (
    "the shape's grid frame: right-handed; where the object stood on a plane, z is the plane's normal and "
    "z = 0 the plane"
)


def export_shape(
    path: Path,
    formats: Sequence[str],
    out: Path,
    *,
    units: Units = "m",
    shells: bool = False,
) -> list[Path]:
    """Write a shape in every format, and manifest.json.

    Args:
        path: NAME.npz.
        formats: of `SHAPE_FORMATS`.
        out: folder.
        units: of the mesh files; BOP is in millimetres and GLB in metres by their own rules.
        shells: also the surfaces where the probability is 0.1 and 0.9.

    Returns:
        The files written, the manifest last.

    Raises:
        PipelineError: the shape cannot be read, has no closed surface, or the folder cannot be written.
    """
    name = path.stem
    with usable(path):
        shape = ShapePrior.load(path)
    levels = (0.5, *SHELLS) if shells else (0.5,)
    meshes = {level: shape_mesh(shape, name, level) for level in levels}
    contents: dict[str, bytes] = {}
    entries: list[dict[str, Any]] = []
    for form in formats:
        if form == "bop":
            files, info, models = bop_models({name: meshes[0.5]})
            contents |= {f"bop/{file}": content for file, content in files.items()}
            contents["bop/models/models_info.json"] = json.dumps(info, indent=2).encode()
            entry = models[name]
            entries.append({"format": "bop", "units": "mm", **entry, "file": f"bop/{entry['file']}"})
        elif form == "npz":
            contents[f"{name}.npz"] = path.read_bytes()
            entries.append({"format": "npz", "units": "m", "file": f"{name}.npz"})
        else:
            for level, mesh in meshes.items():
                file = f"{name}{'' if level == 0.5 else f'.p{100 * level:.0f}'}.{form}"
                written: Units = "m" if form == "glb" else units
                contents[file] = mesh_bytes(moved(mesh, np.eye(4), written), form)
                entries.append({"format": form, "units": written, "file": file, "level": level})
    manifest = {
        "format_version": 1,
        "shape": name,
        "frame": FRAME,
        "pitch_m": shape.pitch_m,
        "reference_from_grid": shape.reference_from_grid.tolist(),
        "size_m": meshes[0.5].extents.tolist(),
        "volume_m3": float(meshes[0.5].volume),
        "files": entries,
    }
    return write_files(out, contents, manifest)


def write_files(out: Path, contents: dict[str, bytes], manifest: dict[str, Any]) -> list[Path]:
    """Write files into a folder, each whole or not at all, and manifest.json when all the others stand."""
    paths = []
    for name, content in contents.items():
        path = out / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise PipelineError(f"cannot make the folder {path.parent}: {error.strerror}") from error
        with atomic_path(path) as partial:
            partial.write_bytes(content)
        paths.append(path)
    write_json(out / "manifest.json", manifest)
    return [*paths, out / "manifest.json"]
