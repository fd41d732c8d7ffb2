"""Writes shapes one by one, each in every format asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.export.bop import IDS_FILE, MODELS, bop_models
from pipeline.export.files import write_files
from pipeline.export.meshes import Unseen, glb_bytes, mesh_bytes, moved
from pipeline.export.models import ExportModel, Origin
from pipeline.export.simulators import DENSITY_KG_M3, simulator_files
from pipeline.meshes import Units

SIMULATORS = frozenset({"urdf", "mjcf"})
"""Formats whose readers take a surface for a solid with a volume."""
SOLIDS = SIMULATORS | {"bop"}
"""Formats that what was learned is closed for; meshes for BOP may have holes, as YCB-Video's own have."""
MODEL_FORMATS = ("npz", "ply", "obj", "glb", "stl", "bop", "urdf", "mjcf")
GROWING = (f"{MODELS}/models_info.json", IDS_FILE)
"""Files to which a second export adds."""


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """How shapes are written.

    Attributes:
        units: of ply, obj and stl; the other formats have units of their own.
        origin: of learned shapes: middle of the footprint, of the bounding box, or the grid's corner. BOP
            has the middle by its own rules.
        shells: also the surfaces where the probability is 0.1 and 0.9.
        unseen: whether learned surfaces close behind what was seen, or are open there.
        ids: of shapes in BOP's files, by name.
        density: of the solids for simulators, in kg/m^3.
        force: replace files that say something else.
    """

    units: Units = "m"
    origin: Origin = "base"
    shells: bool = False
    unseen: Unseen = "fill"
    ids: Mapping[str, int] = field(default_factory=dict)
    density: float = DENSITY_KG_M3
    force: bool = False


def export_models(
    models: Sequence[ExportModel],
    formats: Sequence[str],
    out: Path,
    options: ExportOptions,
    more: Mapping[str, bytes] | None = None,
) -> list[Path]:
    """Write shapes in every format, and manifest.json.

    Args:
        models: the shapes.
        formats: of `MODEL_FORMATS`.
        out: folder.
        options: how.
        more: other files that belong to them.

    Returns:
        The files written, the manifest last.

    Raises:
        PipelineError: a file is there that says something else, or the folder cannot be written.
    """
    contents: dict[str, bytes] = dict(more or {})
    entries = {model.name: _facts(model, options) for model in models}
    for model in models:
        for form in formats:
            if form not in ("bop", *SIMULATORS):
                files = _mesh_files(model, form, options)
                contents |= {entry["file"]: content for entry, content in files}
                entries[model.name]["files"] += [entry for entry, _ in files]
        simulators = tuple(form for form in formats if form in SIMULATORS)
        if simulators:
            mesh = model.in_frame(options.origin)
            files = simulator_files(
                model.name, mesh, simulators, options.density, model.facts.get("pitch_m", 0.0)
            )
            contents |= files
            kinds = {".urdf": "urdf", ".xml": "mjcf", ".obj": "obj"}
            entries[model.name]["files"] += [
                {"format": kinds[Path(file).suffix], "units": "m", "file": file} for file in files
            ]
    if "bop" in formats:
        files, bop_entries = bop_models(models, out, options.ids)
        contents |= files
        for name, entry in bop_entries.items():
            entries[name]["files"].append({"format": "bop", "units": "mm", **entry})
    return write_files(out, contents, "shapes", entries, grows=GROWING, force=options.force)


def _facts(model: ExportModel, options: ExportOptions) -> dict[str, Any]:
    """What the manifest says of a shape before its files are known."""
    return {
        **model.facts,
        "size_m": model.mesh.extents.tolist(),
        "volume_m3": float(model.mesh.volume) if model.mesh.is_watertight else None,
        "object_from_model": model.own_from_model(options.origin).tolist(),
        "files": [],
    }


def _mesh_files(model: ExportModel, form: str, options: ExportOptions) -> list[tuple[dict[str, Any], bytes]]:
    """Manifest entry and content of each file of a shape in one format."""
    if form == "npz":
        entry = {"format": "npz", "units": "m", "file": f"{model.name}.npz"}
        return [] if model.npz is None else [(entry, model.npz)]
    model_from_own = np.asarray(np.linalg.inv(model.own_from_model(options.origin)), np.float64)
    found = []
    for level, mesh in {0.5: model.mesh, **model.shells}.items():
        stem = model.name if level == 0.5 else f"{model.name}.p{100 * level:.0f}"
        units: Units = "m" if form == "glb" else options.units
        written = moved(mesh, model_from_own, units)
        if form == "glb":
            content = glb_bytes({stem: (written, np.eye(4))}, up=np.array([0.0, 0.0, 1.0]))
        else:
            content = mesh_bytes(written, form)
        entry = {"format": form, "units": units, "file": f"{stem}.{form}", "level": level}
        found.append((entry, content))
    return found
