"""Surfaces survive their file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.errors import PipelineError
from pipeline.surfaces import SceneSurface, Surfaces


def test_surfaces_are_read_as_they_were_written(tmp_path: Path) -> None:
    """Of different sizes, in their order, under any name."""
    meshes = {"mug/2": trimesh.creation.icosphere(1), "a box": trimesh.creation.box((1, 2, 3))}
    surfaces = Surfaces(
        {
            name: SceneSurface(vertices_m=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces, np.int64))
            for name, mesh in meshes.items()
        }
    )
    surfaces.save(tmp_path / "objects.npz")
    found = Surfaces.load(tmp_path / "objects.npz").by_name

    assert list(found) == list(meshes)
    for name, mesh in meshes.items():
        np.testing.assert_array_equal(found[name].vertices_m, mesh.vertices)
        np.testing.assert_array_equal(found[name].faces, mesh.faces)


def test_colours_survive_beside_surfaces_without(tmp_path: Path) -> None:
    """Each vertex keeps its own, in any order."""
    mesh = trimesh.creation.box((1, 2, 3))
    rgb = np.arange(24, dtype=np.uint8).reshape(8, 3)
    plain = SceneSurface(vertices_m=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces, np.int64))
    coloured = replace(plain, rgb=rgb)
    Surfaces({"a": coloured, "b": plain, "c": replace(plain, rgb=rgb[::-1])}).save(tmp_path / "objects.npz")
    found = Surfaces.load(tmp_path / "objects.npz").by_name

    assert found["b"].rgb is None
    np.testing.assert_array_equal(found["a"].rgb, rgb)
    np.testing.assert_array_equal(found["c"].rgb, rgb[::-1])


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    """As damaged."""
    (tmp_path / "objects.npz").write_bytes(b"nothing")
    with pytest.raises(PipelineError, match=r"objects\.npz"):
        Surfaces.load(tmp_path / "objects.npz")
