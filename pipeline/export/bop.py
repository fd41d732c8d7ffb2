"""Models as BOP keeps them: models/obj_NNNNNN.ply in millimetres with normals, and models_info.json.

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from pipeline.bop_numbers import numbered
from pipeline.errors import PipelineError
from pipeline.export.meshes import mesh_bytes
from pipeline.export.models import ExportModel

MODELS = "bop/models"
IDS_FILE = "bop/ids.json"
"""Which shape each model is; of our own, BOP has no names."""
FEW_VERTICES = 1000
"""All pairs of so many are compared within milliseconds."""


def bop_numbers(
    names: Collection[str], out: Path, ids: Mapping[str, int], own: Mapping[str, int] | None = None
) -> dict[str, int]:
    """Ids by name of the models of a folder, of those to be written and of those that it holds already.

    Args:
        names: of the models to be written.
        out: folder of the export; what it holds of earlier ones keeps its ids.
        ids: that were asked for, by name.
        own: of the run, by name, for the others; models with neither get the lowest ids that are left.

    Raises:
        PipelineError: an id belongs to another model of the folder, or a model has another id there.
    """
    held, own = _read(out / IDS_FILE), own or {}
    for name in sorted(names):
        number = ids.get(name, held.get(name, own.get(name)))
        taken = [other for other, one in held.items() if one == number and other != name]
        if taken:
            raise PipelineError(f"{out}: id {number} of {name} is that of {taken[0]} there")
        if name in held and held[name] != number:
            raise PipelineError(f"{out}: {name} has id {held[name]} there, and not {number}")
    return numbered({*held, *names}, held, ids, own)


def bop_models(
    models: Sequence[ExportModel], out: Path, ids: Mapping[str, int]
) -> tuple[dict[str, bytes], dict[str, dict[str, Any]]]:
    """Models of shapes, beside those that the folder holds already.

    Learned shapes have their origin in the middle of the bounding box, as BOP has it; surfaces with frames
    of their own keep them.

    Args:
        models: the shapes.
        out: folder of the export.
        ids: that were asked for, by name.

    Returns:
        Contents by path inside the folder, and for every shape its manifest entry: id, file and
        `object_from_bop`, which maps the model's coordinates in metres to the shape's own.

    Raises:
        PipelineError: as `bop_numbers`.
    """
    numbers = bop_numbers([model.name for model in models], out, ids)
    files: dict[str, bytes] = {}
    info, entries = _read(out / MODELS / "models_info.json"), {}
    for model in models:
        mesh = model.in_frame("middle", "mm")
        number = numbers[model.name]
        path = f"{MODELS}/obj_{number:06d}.ply"
        files[path] = mesh_bytes(mesh, "ply")
        info[str(number)] = model_info(np.asarray(mesh.vertices))
        own_from_bop = model.own_from_model("middle")
        entries[model.name] = {"id": number, "file": path, "object_from_bop": own_from_bop.tolist()}
    files[f"{MODELS}/models_info.json"] = _json(dict(sorted(info.items(), key=lambda one: int(one[0]))))
    files[IDS_FILE] = _json(dict(sorted(numbers.items(), key=lambda one: one[1])))
    return files, entries


def model_info(vertices_mm: NDArray[np.float64]) -> dict[str, float]:
    """A model's entry in models_info.json: diameter and bounding box in millimetres."""
    corners = vertices_mm
    if len(corners) > FEW_VERTICES:
        corners = corners[ConvexHull(corners, qhull_options="QJ").vertices]  # joggled: it may be flat
    low, size = vertices_mm.min(axis=0), np.ptp(vertices_mm, axis=0)
    return {
        "diameter": float(pdist(corners).max()),
        **{f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)},
        **{f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)},
    }


def _json(content: Any) -> bytes:
    return (json.dumps(content, indent=2) + "\n").encode()


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise PipelineError(f"cannot read {path}, which this export would extend: {error}") from error
    if not isinstance(content, dict):
        raise PipelineError(f"{path} is not voxscene's, so it is not extended; name another folder with -o")
    return content
