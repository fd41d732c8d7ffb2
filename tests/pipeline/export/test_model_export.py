"""Exports of a learned shape, opened by the programs that they are for."""

import json
import xml.etree.ElementTree as Xml
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh

from pipeline.bop_numbers import numbered, read_ids
from pipeline.errors import ConfigError, PipelineError
from pipeline.export.meshes import checked
from pipeline.export.model_export import ExportOptions
from pipeline.export.sources import export
from shapes.prior import ShapePrior

PITCH_M = 0.005
SIZE_M = np.asarray([12, 8, 5]) * PITCH_M
"""Of the block; its surface passes half-way between the centres inside and outside."""


@pytest.fixture
def shape_path(tmp_path: Path) -> Path:
    """A hollow block: surely occupied skin, an interior that nothing saw, surely empty surroundings."""
    path = tmp_path / "block.npz"
    block().save(path)
    return path


def block(layers: int = 5) -> ShapePrior:
    """A hollow block so many voxels high, that stands on the plane z = 0."""
    occupied, enclosed = np.zeros((2, 16, 12, 7), np.bool_)
    occupied[2:14, 2:10, :layers] = True
    enclosed[4:12, 4:8, 1 : layers - 1] = True
    occupied &= ~enclosed
    phi = np.where(occupied, 1.0, np.where(enclosed, 0.9, 0.0)).astype(np.float32)
    return ShapePrior(
        phi=phi,
        pitch_m=PITCH_M,
        reference_from_grid=np.eye(4),
        seen_free=~occupied & ~enclosed,
        seen_occupied=occupied,
        enclosed=enclosed,
        rgb=np.full((*phi.shape, 3), (200, 60, 30), np.uint8),
    )


def exported(source: Path, formats: list[str], out: Path, **options) -> list[Path]:
    """Files of an export with some options."""
    return export(source, formats, out, ExportOptions(**options))


@pytest.mark.parametrize("form", ["ply", "obj", "glb", "stl"])
@pytest.mark.parametrize("units", ["m", "mm"])
def test_meshes_open_at_the_right_size(shape_path: Path, tmp_path: Path, form: str, units: str) -> None:
    """In trimesh and in Open3D: closed, outward, no inner wall, metres in GLB whatever the units."""
    exported(shape_path, [form], tmp_path / "out", units=units)
    path = tmp_path / "out" / f"block.{form}"
    scale = 1000.0 if units == "mm" and form != "glb" else 1.0
    mesh = trimesh.load_mesh(path)
    size = SIZE_M[[0, 2, 1]] if form == "glb" else SIZE_M * scale
    np.testing.assert_allclose(mesh.extents, size, rtol=1e-5)
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert 0.9 * SIZE_M.prod() * scale**3 < mesh.volume <= SIZE_M.prod() * scale**3
    other = o3d.io.read_triangle_mesh(str(path))  # pyright: ignore
    np.testing.assert_allclose(other.get_axis_aligned_bounding_box().get_extent(), size, rtol=1e-5)
    other.merge_close_vertices(1e-6 * scale)
    assert other.is_watertight()


def test_colours_arrive(shape_path: Path, tmp_path: Path) -> None:
    """In the formats that have colours for vertices."""
    exported(shape_path, ["ply", "obj", "glb"], tmp_path / "out")
    for form in ("ply", "obj", "glb"):
        colours = getattr(trimesh.load_mesh(tmp_path / "out" / f"block.{form}").visual, "vertex_colors", None)
        assert colours is not None
        assert (np.asarray(colours)[:, :3] == (200, 60, 30)).all()


def test_the_model_itself_is_a_copy(shape_path: Path, tmp_path: Path) -> None:
    """The npz has the same bytes."""
    exported(shape_path, ["npz"], tmp_path / "out")
    assert (tmp_path / "out" / "block.npz").read_bytes() == shape_path.read_bytes()


def test_bop_folder_has_its_layout(shape_path: Path, tmp_path: Path) -> None:
    """Millimetres, origin in the middle, diameter over all pairs, and the way back in the manifest."""
    exported(shape_path, ["bop"], tmp_path / "out")
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
    back = np.asarray(manifest["shapes"]["block"]["files"][0]["object_from_bop"])
    original = ShapePrior.load(shape_path).bounding_box_m
    restored = trimesh.transform_points(mesh.bounds / 1000, back)
    np.testing.assert_allclose(restored, original, atol=1e-6)


def test_shells_contain_each_other(shape_path: Path, tmp_path: Path) -> None:
    """The surface where the probability is 0.1 surrounds that of 0.5, and that the one of 0.9."""
    exported(shape_path, ["stl"], tmp_path / "out", shells=True)
    names = ("block.p10.stl", "block.stl", "block.p90.stl")
    outer, middle, inner = (trimesh.load_mesh(tmp_path / "out" / name).volume for name in names)
    assert outer > middle > inner > 0


def test_the_manifest_names_every_file(shape_path: Path, tmp_path: Path) -> None:
    """With its units, and the frame they are in."""
    written = exported(shape_path, ["ply", "glb", "bop"], tmp_path / "out", units="mm")
    manifest = json.loads(written[-1].read_text())["shapes"]["block"]
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
        exported(tmp_path / "cup.npz", ["ply"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_gltf_has_y_up_and_names(shape_path: Path, tmp_path: Path) -> None:
    """The support's normal is +y: the base lies on y = 0, the rest above; the node has the shape's name."""
    exported(shape_path, ["glb"], tmp_path / "out")
    scene = trimesh.load_scene(tmp_path / "out" / "block.glb")
    assert scene.graph.nodes_geometry == ["block"]
    low, high = scene.bounds
    np.testing.assert_allclose([low[1], high[1]], [0, SIZE_M[2]], atol=1e-6)
    np.testing.assert_allclose((low + high)[[0, 2]], 0, atol=1e-6)


@pytest.mark.parametrize(
    ("origin", "place"),
    [("base", [0, 0, 2.5]), ("middle", [0, 0, 0]), ("grid", [8, 6, 2.5])],
)
def test_the_origin_is_where_it_was_asked_for(shape_path, tmp_path: Path, origin: str, place: list) -> None:
    """Middle of the box, by the origin; the manifest leads back to the grid."""
    exported(shape_path, ["ply"], tmp_path / "out", origin=origin)
    mesh = trimesh.load_mesh(tmp_path / "out" / "block.ply")
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), np.array(place) * PITCH_M, atol=1e-6)
    entry = json.loads((tmp_path / "out" / "manifest.json").read_text())["shapes"]["block"]
    in_grid = trimesh.transform_points(mesh.bounds, np.array(entry["object_from_model"]))
    np.testing.assert_allclose(in_grid, ShapePrior.load(shape_path).bounding_box_m, atol=1e-6)


def test_two_exports_into_one_folder_are_both_whole(shape_path: Path, tmp_path: Path) -> None:
    """Each model has an id of its own, models_info.json, ids.json and the manifest tell of both."""
    other = tmp_path / "flat.npz"
    block(3).save(other)
    exported(shape_path, ["bop", "ply"], tmp_path / "out")
    first = (tmp_path / "out/bop/models/obj_000001.ply").read_bytes()
    exported(other, ["bop", "ply"], tmp_path / "out")
    models = tmp_path / "out" / "bop" / "models"
    assert (models / "obj_000001.ply").read_bytes() == first
    assert trimesh.load_mesh(models / "obj_000002.ply").extents[2] == pytest.approx(15)
    assert sorted(json.loads((models / "models_info.json").read_text())) == ["1", "2"]
    assert json.loads((tmp_path / "out/bop/ids.json").read_text()) == {"block": 1, "flat": 2}
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert sorted(manifest["shapes"]) == ["block", "flat"]
    files = [file["file"] for entry in manifest["shapes"].values() for file in entry["files"]]
    assert all((tmp_path / "out" / file).is_file() for file in files)


def test_another_shape_of_the_same_name_is_refused(shape_path: Path, tmp_path: Path) -> None:
    """Nothing of the first export changes, unless --force says so; the same again is no conflict."""
    exported(shape_path, ["bop", "ply"], tmp_path / "out")
    exported(shape_path, ["bop", "ply"], tmp_path / "out")
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    (tmp_path / "b").mkdir()
    block(3).save(tmp_path / "b" / "block.npz")
    with pytest.raises(PipelineError, match=r"block\.ply is there and differs.*--force"):
        exported(tmp_path / "b" / "block.npz", ["bop", "ply"], tmp_path / "out")
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()} == before
    exported(tmp_path / "b" / "block.npz", ["ply"], tmp_path / "out", force=True)
    assert trimesh.load_mesh(tmp_path / "out" / "block.ply").extents[2] == pytest.approx(0.015)


def test_the_manifest_tells_the_truth_of_files_from_earlier_exports(shape_path: Path, tmp_path: Path) -> None:
    """What is said of another origin is refused, and with --force the earlier files are left out."""
    exported(shape_path, ["ply"], tmp_path / "out")
    before = (tmp_path / "out/manifest.json").read_bytes()
    with pytest.raises(PipelineError, match=r"block\.ply is there with another object_from_model.*--force"):
        exported(shape_path, ["obj"], tmp_path / "out", origin="grid")
    assert (tmp_path / "out/manifest.json").read_bytes() == before
    assert not (tmp_path / "out/block.obj").exists()
    exported(shape_path, ["stl"], tmp_path / "out", units="mm")
    exported(shape_path, ["obj"], tmp_path / "out", origin="grid", force=True)
    entry = json.loads((tmp_path / "out/manifest.json").read_text())["shapes"]["block"]
    assert [file["file"] for file in entry["files"]] == ["block.obj"]
    assert entry["object_from_model"] == np.eye(4).tolist()
    assert (tmp_path / "out/block.ply").is_file()


def test_a_folder_of_shapes_is_one_data_set_with_the_ids_asked_for(shape_path: Path, tmp_path: Path) -> None:
    """--ids names some, the others get the lowest that are left; an id taken by another is refused."""
    block(3).save(tmp_path / "flat.npz")
    block(2).save(tmp_path / "low.npz")
    exported(tmp_path, ["bop"], tmp_path / "out", ids={"flat": 1, "low": 14})
    assert json.loads((tmp_path / "out/bop/ids.json").read_text()) == {"flat": 1, "block": 2, "low": 14}
    with pytest.raises(PipelineError, match="id 14 of block is that of low"):
        exported(shape_path, ["bop"], tmp_path / "out", ids={"block": 14})


def test_ids_are_unique_whatever_the_sources_say() -> None:
    """The more trusted source first; what clashes gets a number that is left."""
    assert numbered(["a", "b", "c"], {"b": 2}, {"a": 2, "c": 9}) == {"b": 2, "c": 9, "a": 1}


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("{", "not JSON"),
        ('{"a": 0}', "write ids by name"),
        ('{"a": 1, "b": 1}', "two names"),
        (None, "cannot"),
    ],
)
def test_an_ids_file_that_says_something_else_is_refused(tmp_path: Path, text: str, line: str) -> None:
    """In one line that names it."""
    if text is not None:
        (tmp_path / "ids.json").write_text(text)
    with pytest.raises(ConfigError, match=line):
        read_ids(tmp_path / "ids.json")


def test_simulator_files_have_the_solids_mass_and_convex_parts(shape_path: Path, tmp_path: Path) -> None:
    """Mass is density times volume in both; every part is convex, and together they fill the block."""
    exported(shape_path, ["urdf", "mjcf"], tmp_path / "out", density=500.0)
    out = tmp_path / "out"
    volume = json.loads((out / "manifest.json").read_text())["shapes"]["block"]["volume_m3"]
    robot, model = Xml.parse(out / "block.urdf").getroot(), Xml.parse(out / "block.xml").getroot()
    (mass,), (inertial,) = robot.iter("mass"), model.iter("inertial")
    masses = [float(mass.attrib["value"]), float(inertial.attrib["mass"])]
    np.testing.assert_allclose(masses, 500 * volume, rtol=1e-6)
    ((moments),) = (one.attrib for one in robot.iter("inertia"))
    box = masses[0] / 12 * (SIZE_M**2).sum() - masses[0] / 12 * SIZE_M**2
    np.testing.assert_allclose([float(moments[key]) for key in ("ixx", "iyy", "izz")], box, rtol=0.05)
    parts = [
        trimesh.load_mesh(out / one.attrib["filename"])
        for one in robot.findall("link/collision/geometry/mesh")
    ]
    assert all(part.is_convex for part in parts)
    assert sum(part.volume for part in parts) == pytest.approx(SIZE_M.prod(), rel=0.1)
    files = [one.attrib["file"] for one in model.findall("asset/mesh")]
    assert all((out / file).is_file() for file in files)
    assert len(files) == len(parts) + 1


def test_vertex_normals_point_outward_in_bops_models(shape_path: Path, tmp_path: Path) -> None:
    """BOP asks for them; of a convex block they look away from its middle."""
    exported(shape_path, ["bop"], tmp_path / "out")
    header = (tmp_path / "out/bop/models/obj_000001.ply").read_bytes()[:600]
    assert b"property float nx" in header
    mesh = trimesh.load_mesh(tmp_path / "out/bop/models/obj_000001.ply", process=False)
    assert (np.einsum("ij,ij->i", mesh.vertex_normals, mesh.vertices) > 0).all()
