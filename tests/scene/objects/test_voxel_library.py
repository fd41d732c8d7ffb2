"""Voxels on disk: those that were made, and damaged ones never."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from pipeline.synthesis.objects import built_in_object
from scene.objects import voxel_library
from scene.objects.voxel_library import voxelise
from shapes import array_cache
from shapes.archive import load_arrays, save_arrays
from shapes.rendering.object_library import ObjectLibrary, library_of_mesh

PITCH_M = 0.004


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of its own."""
    monkeypatch.setattr(array_cache, "user_cache_path", lambda *_, **__: tmp_path)
    return tmp_path / "voxels"


def same(one: ObjectLibrary, other: ObjectLibrary) -> bool:
    """Whether two are equal, types too."""
    pairs = [[np.asarray(getattr(of, field.name)) for of in (one, other)] for field in fields(one)]
    return all(first.dtype == second.dtype and np.array_equal(first, second) for first, second in pairs)


def test_voxels_are_kept_and_read(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second time nothing is made; another pitch has a file of its own."""
    mesh = built_in_object("mug")
    expected = library_of_mesh(mesh.vertices, mesh.faces, PITCH_M)
    made = voxelise(mesh.vertices, mesh.faces, PITCH_M)
    monkeypatch.setattr(voxel_library, "library_of_mesh", None)

    assert same(made, expected)
    assert same(voxelise(mesh.vertices, mesh.faces, PITCH_M), expected)
    with pytest.raises(TypeError):
        voxelise(mesh.vertices, mesh.faces, 2 * PITCH_M)
    assert len(list(folder.iterdir())) == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("table", np.zeros(7, np.int32)),  # kernels would read beyond it
        ("size", np.full((1, 3), 1000, np.int32)),
        ("size", np.full((1, 3), -8, np.int32)),
        ("first_voxel", np.full(1, 5, np.int32)),
        ("pitch_m", np.full(1, 0.004)),  # of another type
        ("radius_m", None),
        ("more", np.zeros(1)),
    ],
)
def test_what_does_not_fit_together_is_made_anew(folder: Path, name: str, value: np.ndarray | None) -> None:
    """And the file is mended."""
    mesh = built_in_object("mug")
    made = voxelise(mesh.vertices, mesh.faces, PITCH_M)
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    arrays = load_arrays(path)
    changed = {one: array for one, array in arrays.items() if one != name}
    save_arrays(path, changed if value is None else {**changed, name: value})

    assert same(voxelise(mesh.vertices, mesh.faces, PITCH_M), made)
    assert path.read_bytes() == whole


def test_a_mesh_without_faces_is_refused(folder: Path) -> None:
    """And nothing is kept of it."""
    with pytest.raises(ValueError, match="without faces"):
        voxelise(np.zeros((3, 3)), np.zeros((0, 3), int), PITCH_M)
    assert not folder.exists()
