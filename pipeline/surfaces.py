"""Surfaces of the objects that a run looked for, kept with it: pictures and exports need nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from shapes.archive import load_arrays, save_arrays


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneSurface:
    """A closed surface in metres, in the object's own frame.

    Attributes:
        vertices_m: (V, 3).
        faces: (F, 3) rows of `vertices_m`, counter-clockwise from outside.
    """

    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int64]

    @property
    def middle_m(self) -> NDArray[np.float64]:
        """Middle (3,) of the bounding box."""
        return (self.vertices_m.min(axis=0) + self.vertices_m.max(axis=0)) / 2


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Surfaces by name.

    Attributes:
        by_name: in the order of the search.
    """

    by_name: Mapping[str, SceneSurface]

    def save(self, path: Path) -> None:
        """Write an npz file, whole or not at all; equal surfaces give equal bytes."""
        each = list(self.by_name.values())
        save_arrays(
            path,
            {
                "names": np.array(list(self.by_name), str),
                "vertex_counts": np.array([len(one.vertices_m) for one in each], np.int64),
                "face_counts": np.array([len(one.faces) for one in each], np.int64),
                "vertices_m": np.concatenate([one.vertices_m for one in each]).astype(np.float64),
                "faces": np.concatenate([one.faces for one in each]).astype(np.int64),
            },
        )

    @classmethod
    def load(cls, path: Path) -> Surfaces:
        """Read what `save` wrote.

        Raises:
            PipelineError: the file is damaged.
        """
        try:
            arrays = load_arrays(path)
            vertices = np.split(arrays["vertices_m"], np.cumsum(arrays["vertex_counts"])[:-1])
            faces = np.split(arrays["faces"], np.cumsum(arrays["face_counts"])[:-1])
            names = arrays["names"].tolist()
        except (ValueError, KeyError) as error:
            raise PipelineError(f"{path} is damaged: {error}") from error
        pairs = zip(names, vertices, faces, strict=True)
        return cls({name: SceneSurface(vertices_m=points, faces=rows) for name, points, rows in pairs})
