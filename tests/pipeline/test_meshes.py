"""Folders of meshes are read in metres, or refused in one line."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals

from pipeline.errors import PipelineError
from pipeline.meshes import load_meshes, vertex_rgb
from pipeline.shape_folder import holds_learned_shapes, load_surfaces


def folder(tmp_path: Path, scale: float = 1.0, suffix: str = ".ply") -> Path:
    """One box of 10 x 20 x 30 cm, scaled."""
    mesh = trimesh.creation.box((0.1 * scale, 0.2 * scale, 0.3 * scale))
    mesh.export(tmp_path / f"box{suffix}")
    return tmp_path


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".glb", ".off"])
def test_every_format_is_read_in_metres(tmp_path: Path, suffix: str) -> None:
    """By the name of its file, with seams closed."""
    meshes = load_meshes(folder(tmp_path, suffix=suffix))

    assert list(meshes) == ["box"]
    assert sorted(meshes["box"].extents.round(6)) == [0.1, 0.2, 0.3]
    assert meshes["box"].is_watertight


def test_millimetres_are_scaled_when_said_or_when_bops(tmp_path: Path) -> None:
    """A list, as YCB-Video's copies bring, is not BOP's; a dict with diameters is."""
    folder(tmp_path, 1000.0)
    with pytest.raises(PipelineError, match="is it in mm \\(--units mm"):
        load_meshes(tmp_path)
    assert load_meshes(tmp_path, "mm")["box"].extents.max() == pytest.approx(0.3)

    (tmp_path / "models_info.json").write_text(json.dumps([{"diameter": 3}]))
    with pytest.raises(PipelineError, match="is it in mm"):
        load_meshes(tmp_path)
    (tmp_path / "models_info.json").write_text(json.dumps({"1": {"diameter": 374.2}}))
    assert load_meshes(tmp_path)["box"].extents.max() == pytest.approx(0.3)


def test_metres_taken_for_millimetres_are_noticed(tmp_path: Path) -> None:
    """A box of 0.3 mm is no object."""
    with pytest.raises(PipelineError, match="is it in m "):
        load_meshes(folder(tmp_path), "mm")


def test_what_holds_no_mesh_is_refused(tmp_path: Path) -> None:
    """A missing folder, an empty one, a broken file, a cloud without triangles."""
    with pytest.raises(PipelineError, match="no folder of meshes"):
        load_meshes(tmp_path / "none")
    with pytest.raises(PipelineError, match="holds no meshes"):
        load_meshes(tmp_path)
    (tmp_path / "broken.ply").write_bytes(b"ply\nnonsense")
    with pytest.raises(PipelineError, match=r"broken\.ply"):
        load_meshes(tmp_path)
    trimesh.PointCloud([[0, 0, 0], [1, 0, 0]]).export(tmp_path / "broken.ply")
    with pytest.raises(PipelineError, match=r"broken\.ply"):
        load_meshes(tmp_path)


@pytest.mark.parametrize(("side_m", "told"), [(0.0, "the same point"), (1e30, r"1e\+30 m large")])
def test_a_mesh_of_no_size_that_things_have_is_refused(tmp_path: Path, side_m: float, told: str) -> None:
    """Nothing overflows on the way."""
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    trimesh.Trimesh(box.vertices * (10 * side_m), box.faces, process=False).export(tmp_path / "box.ply")
    with pytest.raises(PipelineError, match=told):
        load_meshes(tmp_path)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".glb"])
def test_colours_of_vertices_are_kept(tmp_path: Path, suffix: str) -> None:
    """At the vertices that had them, whatever order the file brings."""
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    rgb = np.where(box.vertices[:, 2:] > 0, [[200, 10, 30]], [[20, 110, 60]]).astype(np.uint8)
    mesh = trimesh.Trimesh(box.vertices, box.faces, vertex_colors=rgb)
    mesh.export(tmp_path / f"box{suffix}")
    found = load_surfaces(tmp_path)["box"]

    assert found.rgb is not None
    expected = np.where(found.vertices_m[:, 2:] > 0, [[200, 10, 30]], [[20, 110, 60]])
    np.testing.assert_allclose(found.rgb, expected, atol=1)


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_textures_are_sampled_at_the_vertices(tmp_path: Path, suffix: str) -> None:
    """Red above, blue below."""
    picture = Image.fromarray(np.repeat(np.array([[[255, 0, 0]], [[0, 0, 255]]], np.uint8), 16, axis=0))
    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    heights = np.asarray(mesh.vertices)[:, 2]
    uv = np.stack([np.full(len(heights), 0.5), np.where(heights > 0, 0.9, 0.1)], axis=1)
    mesh.visual = TextureVisuals(uv=uv, image=picture)
    mesh.export(tmp_path / f"box{suffix}")
    found = load_surfaces(tmp_path)["box"]

    assert found.rgb is not None
    expected = np.where(found.vertices_m[:, 2:] > 0, [[255, 0, 0]], [[0, 0, 255]])
    np.testing.assert_allclose(found.rgb, expected, atol=2)


def test_a_mesh_without_colour_has_none(tmp_path: Path) -> None:
    """The grey that a viewer would paint it in is nobody's measurement."""
    assert vertex_rgb(load_meshes(folder(tmp_path))["box"]) is None
    assert load_surfaces(tmp_path)["box"].rgb is None


def test_a_folder_holds_meshes_or_learned_shapes(tmp_path: Path) -> None:
    """Solids compete with meshes alone: `pipeline.stages.parse`."""
    assert not holds_learned_shapes(folder(tmp_path))
    (tmp_path / "box.npz").touch()
    assert holds_learned_shapes(tmp_path)


def test_learned_shapes_have_no_units_to_give(tmp_path: Path) -> None:
    """They are in metres; millimetres asked of them would be taken for granted otherwise."""
    (tmp_path / "mug.npz").touch()
    with pytest.raises(PipelineError, match="leave --units out"):
        load_surfaces(tmp_path, "mm")
