"""Exports of a learned shape, opened by the programs that they are for."""

import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh

from pipeline.errors import PipelineError
from pipeline.export.meshes import checked
from pipeline.export.shape_export import export_shape
from shapes.prior import ShapePrior

PITCH_M = 0.005
SIZE_M = np.asarray([12, 8, 5]) * PITCH_M
"""Of the block; its surface passes half-way between the centres inside and outside."""


@pytest.fixture
def shape_path(tmp_path: Path) -> Path:
    """A hollow block: surely occupied skin, an interior that nothing saw, surely empty surroundings."""
    occupied, enclosed = np.zeros((2, 16, 12, 7), np.bool_)
    occupied[2:14, 2:10, :5] = True
    enclosed[4:12, 4:8, 1:4] = True
    occupied &= ~enclosed
    phi = np.where(occupied, 1.0, np.where(enclosed, 0.9, 0.0)).astype(np.float32)
    shape = ShapePrior(
        phi=phi,
        pitch_m=PITCH_M,
        reference_from_grid=np.eye(4),
        seen_free=~occupied & ~enclosed,
        seen_occupied=occupied,
        enclosed=enclosed,
        rgb=np.full((*phi.shape, 3), (200, 60, 30), np.uint8),
    )
    path = tmp_path / "block.npz"
    shape.save(path)
    return path


@pytest.mark.parametrize("form", ["ply", "obj", "glb", "stl"])
@pytest.mark.parametrize("units", ["m", "mm"])
def test_meshes_open_at_the_right_size(shape_path: Path, tmp_path: Path, form: str, units: str) -> None:
    """In trimesh and in Open3D: closed, outward, no inner wall, metres in GLB whatever the units."""
    export_shape(shape_path, [form], tmp_path / "out", units=units)  # type: ignore[arg-type]
    path = tmp_path / "out" / f"block.{form}"
    scale = 1000.0 if units == "mm" and form != "glb" else 1.0
    mesh = trimesh.load_mesh(path)
    np.testing.assert_allclose(mesh.extents, SIZE_M * scale, rtol=1e-5)
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert 0.9 * SIZE_M.prod() * scale**3 < mesh.volume <= SIZE_M.prod() * scale**3
    other = o3d.io.read_triangle_mesh(str(path))  # pyright: ignore
    np.testing.assert_allclose(other.get_axis_aligned_bounding_box().get_extent(), SIZE_M * scale, rtol=1e-5)
    other.merge_close_vertices(1e-6 * scale)
    assert other.is_watertight()


def test_colours_arrive(shape_path: Path, tmp_path: Path) -> None:
    """In the formats that have colours for vertices."""
    export_shape(shape_path, ["ply", "obj", "glb"], tmp_path / "out")
    for form in ("ply", "obj", "glb"):
        colours = getattr(trimesh.load_mesh(tmp_path / "out" / f"block.{form}").visual, "vertex_colors", None)
        assert colours is not None
        assert (np.asarray(colours)[:, :3] == (200, 60, 30)).all()


def test_the_model_itself_is_a_copy(shape_path: Path, tmp_path: Path) -> None:
    """The npz has the same bytes."""
    export_shape(shape_path, ["npz"], tmp_path / "out")
    assert (tmp_path / "out" / "block.npz").read_bytes() == shape_path.read_bytes()


def test_bop_folder_has_its_layout(shape_path: Path, tmp_path: Path) -> None:
    """Millimetres, origin in the middle, diameter over all pairs, and the way back in the manifest."""
    export_shape(shape_path, ["bop"], tmp_path / "out")
    models = tmp_path / "out" / "bop" / "models"
    assert sorted(path.name for path in models.iterdir()) == ["models_info.json", "obj_000001.ply"]
    info = json.loads((models / "models_info.json").read_text())["1"]
    mesh = trimesh.load_mesh(models / "obj_000001.ply")
    vertices = np.asarray(mesh.vertices)
    pairs = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)
    assert info["diameter"] == pytest.approx(pairs.max(), rel=1e-5)
    for axis, letter in enumerate("xyz"):
        assert info[f"min_{letter}"] == pytest.approx(vertices[:, axis].min(), rel=1e-5)
        assert info[f"size_{letter}"] == pytest.approx(1000 * SIZE_M[axis], rel=1e-5)
        assert info[f"min_{letter}"] == pytest.approx(-info[f"size_{letter}"] / 2, rel=1e-5)
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    back = np.asarray(manifest["files"][0]["object_from_bop"])
    original = ShapePrior.load(shape_path).bounding_box_m
    restored = trimesh.transform_points(mesh.bounds / 1000, back)
    np.testing.assert_allclose(restored, original, atol=1e-6)


def test_shells_contain_each_other(shape_path: Path, tmp_path: Path) -> None:
    """The surface where the probability is 0.1 surrounds that of 0.5, and that the one of 0.9."""
    export_shape(shape_path, ["stl"], tmp_path / "out", shells=True)
    names = ("block.p10.stl", "block.stl", "block.p90.stl")
    outer, middle, inner = (trimesh.load_mesh(tmp_path / "out" / name).volume for name in names)
    assert outer > middle > inner > 0


def test_the_manifest_names_every_file(shape_path: Path, tmp_path: Path) -> None:
    """With its units, and the frame they are in."""
    written = export_shape(shape_path, ["ply", "glb", "bop"], tmp_path / "out", units="mm")
    manifest = json.loads(written[-1].read_text())
    units = {entry["file"]: entry["units"] for entry in manifest["files"]}
    assert units == {"block.ply": "mm", "block.glb": "m", "bop/models/obj_000001.ply": "mm"}
    np.testing.assert_allclose(manifest["size_m"], SIZE_M, rtol=1e-6)


def test_an_open_or_inward_surface_is_refused() -> None:
    """Nothing that does not bound a volume is written."""
    box = trimesh.creation.box()
    inward = trimesh.Trimesh(box.vertices, box.faces[:, ::-1], process=False)
    for mesh in (inward, trimesh.Trimesh(box.vertices, box.faces[1:], process=False)):
        with pytest.raises(PipelineError, match="not closed and outward"):
            checked(mesh, "box")


def test_a_file_that_is_no_shape_is_told(tmp_path: Path) -> None:
    """In one line, and no folder appears."""
    (tmp_path / "cup.npz").write_bytes(b"no archive")
    with pytest.raises(PipelineError, match=r"cannot use the shape .*cup\.npz"):
        export_shape(tmp_path / "cup.npz", ["ply"], tmp_path / "out")
    assert not (tmp_path / "out").exists()
