"""Directories of meshes, as files from elsewhere bring them: named triangle surfaces in metres."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.logs import log
from pipeline.surfaces import MESH_SUFFIXES
from recordings.settings import TEXT

Units = Literal["m", "mm"]

LARGEST_M = 5.0
"""A larger object is more likely written in millimetres."""
SMALLEST_M = 0.004
"""A smaller one, of which a depth camera sees nothing, more likely in metres taken for millimetres."""

FLAT = 1e-6
"""Thickness over length below which a mesh has no volume to rest on or to stand by."""


def load_meshes(folder: Path, units: Units | None = None) -> dict[str, trimesh.Trimesh]:
    """Every mesh of a folder by the name of its file, in metres, with the colours of its vertices.

    Args:
        folder: holds `NAME.ply`, `.obj`, `.stl`, `.glb` or `.off`.
        units: of the files; None takes metres, and millimetres beside a models_info.json of BOP.

    Raises:
        PipelineError: there is no mesh, one cannot be read, or its size is not that of an object.
    """
    if not folder.is_dir():
        raise PipelineError(f"no folder of meshes {folder}")
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in MESH_SUFFIXES)
    if not paths:
        raise PipelineError(f"{folder} holds no meshes ({', '.join(MESH_SUFFIXES)})")
    twice = sorted({path.stem for path in paths if sum(path.stem == one.stem for one in paths) > 1})
    if twice:
        raise PipelineError(f"{folder} holds several meshes named {twice[0]}; leave one of them")
    scale = 0.001 if (units or _units_of(folder)) == "mm" else 1.0
    return {path.stem: _load_mesh(path, scale) for path in paths}


def _load_mesh(path: Path, scale: float) -> trimesh.Trimesh:
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh's readers raise whatever their parsing meets
        raise PipelineError(f"cannot read mesh {path}: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise PipelineError(f"{path} holds no triangles")
    if not np.isfinite(mesh.vertices).all():
        raise PipelineError(f"{path} holds a vertex that is not finite")
    check_size(path, scale * float(np.ptp(mesh.vertices, axis=0).max()))
    rgb = _colours(path, mesh)
    mesh = trimesh.Trimesh(mesh.vertices * scale, mesh.faces, vertex_colors=rgb, process=True)
    spread = np.linalg.svd(mesh.vertices - mesh.vertices.mean(axis=0), compute_uv=False)
    if spread[-1] < FLAT * spread[0]:
        raise PipelineError(f"{path} is flat: an object that can be seen from all sides has a volume")
    return mesh


def vertex_rgb(mesh: trimesh.Trimesh) -> NDArray[np.uint8] | None:
    """Colours (V, 3) of a mesh's vertices, sampled from its texture where it has one; None without colour."""
    visual: Any = mesh.visual
    if visual.kind == "texture":
        material = visual.material
        textured = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
        if textured is not None and visual.uv is not None:
            visual = visual.to_color()
        elif getattr(material, "baseColorFactor", None) is not None:
            return np.tile(np.asarray(material.main_color, np.uint8)[:3], (len(mesh.vertices), 1))
        else:
            return None
    if visual.kind not in ("vertex", "face"):
        return None
    return np.asarray(visual.vertex_colors, np.uint8)[:, :3]


def _colours(path: Path, mesh: trimesh.Trimesh) -> NDArray[np.uint8] | None:
    try:
        return vertex_rgb(mesh)
    except Exception as error:  # a texture's decoder raises whatever it meets; the geometry serves without
        log.warning("%s: its colours cannot be read (%s); it goes without", path, error)
        return None


def check_size(path: Path, extent_m: float) -> None:
    """Refuse what is not as large as an object that a depth camera sees.

    Raises:
        PipelineError: it is too large or too small; the message says what may have been meant.
    """
    if not extent_m <= LARGEST_M:
        raise PipelineError(
            f"{path} is {extent_m:.4g} m large: no object in a hand; is it in mm (--units mm)?"
        )
    if extent_m == 0:
        raise PipelineError(f"all vertices of {path} are the same point")
    if extent_m < SMALLEST_M:
        raise PipelineError(f"{path} is {extent_m:.4g} m large: no object in a hand; is it in m (--units m)?")


def _units_of(folder: Path) -> Units:
    """Millimetres beside a models_info.json of BOP, which maps ids to a `diameter`; else metres."""
    try:
        models = json.loads((folder / "models_info.json").read_text(encoding=TEXT))
    except (OSError, ValueError):
        return "m"
    is_bop = isinstance(models, dict) and any(
        isinstance(model, dict) and "diameter" in model for model in models.values()
    )
    return "mm" if is_bop else "m"
