"""A folder of shapes to look for: learned ones, or meshes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.errors import PipelineError
from pipeline.fingerprints import file_hash
from pipeline.run_folder import holds_stages
from pipeline.surfaces import MESH_SUFFIXES, SceneSurface

if TYPE_CHECKING:
    import jax

    from pipeline.meshes import Units


def load_surfaces(folder: Path, units: Units | None = None) -> dict[str, SceneSurface]:
    """Every shape of a folder by name: learned shapes (npz) if it holds any, else meshes.

    A run folder stands for the shapes that were learned in it.

    Raises:
        PipelineError: there is none, one cannot be used, or units are given of learned ones.
    """
    from pipeline.meshes import load_meshes, vertex_rgb

    folder = _shapes_of(folder)
    learned = sorted(folder.glob("*.npz"))
    if not learned:
        meshes = load_meshes(folder, units)
        return {
            name: SceneSurface(
                vertices_m=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces), rgb=vertex_rgb(mesh)
            )
            for name, mesh in meshes.items()
        }
    if units is not None:
        raise PipelineError(f"{folder} holds learned shapes, which are in metres: leave --units out")
    return {path.stem: _learned_surface(path) for path in learned}


def holds_learned_shapes(folder: Path) -> bool:
    """Whether its shapes are learned ones, and no meshes."""
    return any(_shapes_of(folder).glob("*.npz"))


def drawn_surfaces(folder: Path, name: str, key: jax.Array, count: int) -> list[SceneSurface]:
    """Surfaces of as many random draws of a learned shape, in the frame of its surface.

    Every voxel is there or not by its own probability; what is enclosed is filled, and what was never
    seen is left out, as in the surface.

    Raises:
        PipelineError: the shape is a mesh, which has no uncertainty, or cannot be used.
    """
    from shapes.prior import ShapePrior
    from shapes.surface import level_surface

    path = _shapes_of(folder) / f"{name}.npz"
    if not path.is_file():
        raise PipelineError(f"shape samples need learned shapes, and {folder} holds no {name}.npz")
    with usable(path):
        shape = ShapePrior.load(path)
        seen = shape.seen_free | shape.seen_occupied
        voxels = np.asarray(shape.sample(key, count)) & seen[None] | shape.enclosed[None]
        meshes = [level_surface(one.astype(np.float32), 0.5, shape.pitch_m) for one in voxels]
    return [
        SceneSurface(vertices_m=mesh.vertices_m, faces=np.asarray(mesh.triangles, np.int64))
        for mesh in meshes
    ]


def surface_hashes(folder: Path) -> dict[str, str]:
    """Hashes of the folder's files by name, to tell whether a shape has changed."""
    return {path.name: file_hash(path) for path in sorted(_shapes_of(folder).iterdir()) if path.is_file()}


def shape_names(folder: Path) -> list[str]:
    """Names of the shapes of a folder, by the names of its files alone.

    Raises:
        PipelineError: there is none.
    """
    folder = _shapes_of(folder)
    names = sorted(path.stem for path in folder.glob("*.npz"))
    names = names or sorted(path.stem for path in folder.iterdir() if path.suffix.lower() in MESH_SUFFIXES)
    if not names:
        raise PipelineError(f"{folder} holds no shapes (.npz, {', '.join(MESH_SUFFIXES)})")
    return names


@contextmanager
def usable(path: Path) -> Iterator[None]:
    """Turn what is wrong with a learned shape's file into an error that names it.

    Raises:
        PipelineError: the shape cannot be read, or has no surface.
    """
    try:
        yield
    except (OSError, ValueError) as error:
        raise PipelineError(f"cannot use the shape {path}: {error}") from error


def chosen(
    surfaces: Mapping[str, SceneSurface], entries: tuple[str, ...], copies: int = 1
) -> dict[str, SceneSurface]:
    """The surfaces that entries such as `mug` or `mug:2` ask for, all of them where there is no entry.

    Args:
        surfaces: of the folder.
        entries: names, each perhaps with a number of copies, which get names of their own.
        copies: of every shape whose entry says no more.

    Raises:
        PipelineError: a name is unknown, or a copy's name is that of another shape.
    """
    from scene.copies import asked_copies, slot_names

    asked = {name: max(count, copies) for name, count in map(asked_copies, entries or tuple(surfaces))}
    missing = sorted(set(asked) - set(surfaces))
    if missing:
        raise PipelineError(f"no shape {missing[0]!r}; there are {', '.join(sorted(surfaces))}")
    each: dict[str, SceneSurface] = {}
    for name, count in asked.items():
        for slot in slot_names([name], count):
            if slot != name and slot in surfaces:
                raise PipelineError(f"a copy of {name!r} would be named like the shape {slot!r}; rename that")
            each[slot] = surfaces[name]
    return each


def _shapes_of(folder: Path) -> Path:
    if folder.is_file():
        raise PipelineError(
            f"{folder} is a file; name its folder, and the shape with --objects {folder.stem}"
        )
    if not folder.is_dir():
        raise PipelineError(f"no folder of shapes {folder}")
    if (folder / "shapes").is_dir():
        return folder / "shapes"
    if holds_stages(folder):
        raise PipelineError(
            f"{folder} is a run without learned shapes; make one: voxscene learn REC -o {folder}"
        )
    return folder


def _learned_surface(path: Path) -> SceneSurface:
    from pipeline.meshes import check_size
    from shapes.prior import ShapePrior

    with usable(path):
        mesh = ShapePrior.load(path).surface()
    check_size(path, float(np.ptp(mesh.vertices_m, axis=0).max()))
    return SceneSurface(
        vertices_m=mesh.vertices_m, faces=np.asarray(mesh.triangles, np.int64), learned=True, rgb=mesh.rgb
    )
