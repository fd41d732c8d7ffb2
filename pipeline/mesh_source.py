"""Where the objects of a bench or data set come from, told in a few words that a worker process can read."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh

from pipeline.bop_numbers import ids_of_models, ids_of_names, numbered
from pipeline.errors import PipelineError
from pipeline.meshes import Units, load_meshes


@dataclass(frozen=True)
class MeshSource:
    """A folder of meshes, or the built-in objects.

    Attributes:
        folder: absolute; None for the built-in objects.
        units: of the folder's meshes; None as `load_meshes` finds them.
        names: of those that are wanted; all where empty.
    """

    folder: Path | None = None
    units: Units | None = None
    names: tuple[str, ...] = ()

    @classmethod
    def of(cls, folder: Path | None, units: Units | None, only: str | None = None) -> MeshSource:
        """As a command's options say it; `only` names some, with commas between them.

        Raises:
            PipelineError: one of these is not there.
        """
        if folder is not None and not folder.is_dir():
            raise PipelineError(f"no folder of meshes {folder}")
        source = cls(None if folder is None else folder.resolve(), units)
        names = tuple(name.strip() for name in only.split(",")) if only else ()
        known = source.meshes
        missing = sorted(set(names) - set(known))
        if missing:
            raise PipelineError(f"no object {missing[0]!r}; there are {', '.join(sorted(known))}")
        return cls(source.folder, units, names)

    @property
    def meshes(self) -> Mapping[str, trimesh.Trimesh]:
        """Surfaces by name in metres, loaded once a process.

        Raises:
            PipelineError: the folder is not there or holds no usable meshes.
        """
        known = _loaded(self.folder, self.units)
        return {name: known[name] for name in self.names} if self.names else known

    @property
    def ids(self) -> dict[str, int]:
        """BOP's number of each mesh: that of its name, of models_info.json, or its place in the folder."""
        known = _loaded(self.folder, self.units)
        listed = ids_of_models(self.folder) if self.folder else {}
        ids = numbered(known, ids_of_names(known), listed)
        return {name: ids[name] for name in self.meshes}

    @property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of each surface."""
        return {name: surface_hash(mesh) for name, mesh in self.meshes.items()}


@lru_cache(maxsize=4)
def _loaded(folder: Path | None, units: Units | None) -> Mapping[str, trimesh.Trimesh]:
    from pipeline.synthesis.objects import built_in_names, built_in_object

    if folder is None:
        return {name: built_in_object(name) for name in built_in_names()}
    return load_meshes(folder, units)


def surface_hash(mesh: trimesh.Trimesh) -> str:
    """SHA-256 of its vertices and faces."""
    digest = hashlib.sha256(np.ascontiguousarray(mesh.vertices, np.float64).tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, np.int64).tobytes())
    return digest.hexdigest()
