"""Surfaces of the objects that a run looked for, kept with it: pictures and exports need nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.bop_numbers import numbered
from pipeline.errors import PipelineError
from recordings.dataset_numbers import DatasetNumbers
from shapes.archive import load_arrays, save_arrays

MESH_SUFFIXES = (".ply", ".obj", ".stl", ".glb", ".off")
"""Of mesh files, as trimesh reads them; here, where nothing heavy is imported."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneSurface:
    """A closed surface in metres, in the object's own frame.

    Attributes:
        vertices_m: (V, 3).
        faces: (F, 3) rows of `vertices_m`, counter-clockwise from outside.
        learned: whether that frame is a learned shape's grid.
        rgb: (V, 3) colours of the vertices, or None.
    """

    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int64]
    learned: bool = False
    rgb: NDArray[np.uint8] | None = None

    @property
    def middle_m(self) -> NDArray[np.float64]:
        """Middle (3,) of the bounding box."""
        return (self.vertices_m.min(axis=0) + self.vertices_m.max(axis=0)) / 2

    @property
    def radius_m(self) -> float:
        """Half the diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.vertices_m, axis=0)) / 2)


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Surfaces by name, and the numbers that BOP's files call them by.

    Attributes:
        by_name: in the order of the search.
        numbers: of surfaces, alike of copies of one shape, and of the recording's scene and images where it
            brings them.
    """

    by_name: Mapping[str, SceneSurface]
    numbers: DatasetNumbers = field(default_factory=DatasetNumbers)

    @property
    def object_ids(self) -> dict[str, int]:
        """An id for every surface, those of `numbers` where it has them; copies of a shape have one."""
        known = {name: one for name, one in self.numbers.object_ids.items() if name in self.by_name}
        ids = numbered(self.by_name, known) | known
        return {name: ids[name] for name in self.by_name}

    @property
    def shape_names(self) -> dict[str, str]:
        """By name of each surface that of its shape: the first with the same id, its own if it is no copy."""
        first: dict[int, str] = {}
        return {name: first.setdefault(number, name) for name, number in self.object_ids.items()}

    def save(self, path: Path) -> None:
        """Write an npz file, whole or not at all; equal surfaces give equal bytes."""
        each, ids = list(self.by_name.values()), self.object_ids
        coloured = [one.rgb for one in each if one.rgb is not None]
        colours = {
            "coloured": np.array([one.rgb is not None for one in each], np.bool_),
            "rgb": np.concatenate([*coloured, np.zeros((0, 3), np.uint8)]),
        }
        save_arrays(
            path,
            {
                "names": np.array(list(self.by_name), str),
                "vertex_counts": np.array([len(one.vertices_m) for one in each], np.int64),
                "face_counts": np.array([len(one.faces) for one in each], np.int64),
                "vertices_m": np.concatenate([one.vertices_m for one in each]).astype(np.float64),
                "faces": np.concatenate([one.faces for one in each]).astype(np.int64),
                "object_ids": np.array(list(ids.values()), np.int64),
                "learned": np.array([one.learned for one in each], np.bool_),
                "scene_id": np.int64(self.numbers.scene_id),
                "image_ids": np.array(list(self.numbers.image_ids.items()), np.int64).reshape(-1, 2),
            }
            | (colours if coloured else {}),
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
            learned = arrays.get("learned", np.zeros(len(names), np.bool_)).tolist()
            colours = _colours(arrays)
            numbers = _numbers(names, arrays) if "object_ids" in arrays else DatasetNumbers()
        except (ValueError, KeyError) as error:
            raise PipelineError(f"{path} is damaged: {error}") from error
        by_name = {
            name: SceneSurface(vertices_m=points, faces=rows, learned=is_learned, rgb=rgb)
            for name, points, rows, is_learned, rgb in zip(
                names, vertices, faces, learned, colours, strict=True
            )
        }
        return cls(by_name, numbers)


def _colours(arrays: Mapping[str, NDArray]) -> list[NDArray[np.uint8] | None]:
    """Of each surface; files from before colours were kept have none."""
    counts = arrays["vertex_counts"]
    coloured = arrays.get("coloured", np.zeros(len(counts), np.bool_))
    rows = np.split(arrays.get("rgb", np.zeros((0, 3), np.uint8)), np.cumsum(counts * coloured)[:-1])
    return [row if has else None for row, has in zip(rows, coloured, strict=True)]


def _numbers(names: list[str], arrays: Mapping[str, NDArray]) -> DatasetNumbers:
    return DatasetNumbers(
        scene_id=int(arrays["scene_id"]),
        image_ids=dict(arrays["image_ids"].tolist()),
        object_ids=dict(zip(names, arrays["object_ids"].tolist(), strict=True)),
    )
