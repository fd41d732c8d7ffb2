"""Surfaces survive their file."""

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


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    """As damaged."""
    (tmp_path / "objects.npz").write_bytes(b"nothing")
    with pytest.raises(PipelineError, match=r"objects\.npz"):
        Surfaces.load(tmp_path / "objects.npz")
