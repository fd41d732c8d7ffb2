"""What a run exports for BOP, read by a reader written from BOP's description of the format alone.

bop_datasets_format.md: models/obj_NNNNNN.ply in mm; results: scene_id,im_id,obj_id,score,R,t,time with R by
rows and t in mm, from the model's coordinates to the camera's.
"""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from pipeline.errors import PipelineError
from pipeline.evaluation.object_poses import add_s_m, model_points
from pipeline.export.model_export import ExportOptions
from pipeline.export.run_export import export_run
from pipeline.publishing.values import RunValues
from pipeline.run_access import open_run_folder
from pipeline.run_folder import RunFolder
from pipeline.surfaces import SceneSurface, Surfaces
from recordings.dataset_numbers import DatasetNumbers
from shapes.prior import ShapePrior
from tests.pipeline.export.test_model_export import block

TRUE_POSE = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3], [0.1, 0.2, 0.3])
FOUND_POSE = trimesh.transformations.rotation_matrix(0.72, [1, 2, 3.1], [0.101, 0.2, 0.297])


def read_models(folder: Path) -> dict[int, trimesh.Trimesh]:
    """Models by obj_id, in metres."""
    ids = [int(number) for number in json.loads((folder / "models_info.json").read_text())]
    return {one: trimesh.load_mesh(folder / f"obj_{one:06d}.ply").apply_scale(1e-3) for one in ids}


def read_poses(path: Path) -> dict[tuple[int, int, int], np.ndarray]:
    """camera_from_model in metres by scene_id, im_id and obj_id."""
    poses = {}
    with path.open() as file:
        for row in csv.DictReader(file):
            pose = np.eye(4)
            pose[:3, :3] = np.array(row["R"].split(), float).reshape(3, 3)
            pose[:3, 3] = np.array(row["t"].split(), float) / 1000
            poses[int(row["scene_id"]), int(row["im_id"]), int(row["obj_id"])] = pose
    return poses


def write_run(path: Path, values: RunValues) -> Path:
    """A run with the trajectory, surfaces and scene of some values."""
    with open_run_folder(path, {"rec": "hash"}) as folder:
        for name, value in {"slam": values.slam, "objects": values.surfaces, "parse": values.scene}.items():
            assert value is not None
            folder.stage(name, type(value).load, lambda value=value: value, settings={}, inputs={})
    return path


@pytest.fixture(params=[True, False], ids=["learned", "mesh"])
def run(request, parsed_run: RunValues, tmp_path: Path) -> Path:
    """A run in which a mug was found; its surface is off the origin of its frame."""
    body = trimesh.creation.box((0.1, 0.06, 0.08)).apply_translation([0.2, 0.1, 0.04])
    surface = SceneSurface(
        vertices_m=np.asarray(body.vertices), faces=np.asarray(body.faces, np.int64), learned=request.param
    )
    names = ("mug", "box", "can")
    assert parsed_run.slam is not None
    assert parsed_run.scene is not None
    numbers = DatasetNumbers(
        scene_id=48, image_ids={int(parsed_run.slam.times_ns[2]): 1031}, object_ids={"mug": 14}
    )
    poses = parsed_run.scene.camera_from_object.copy()
    poses[0] = FOUND_POSE
    values = replace(
        parsed_run,
        surfaces=Surfaces(dict.fromkeys(names, surface), numbers),
        scene=replace(parsed_run.scene, camera_from_object=poses),
    )
    return write_run(tmp_path / "run", values)


def test_the_error_of_what_bop_reads_is_that_of_what_we_found(run: Path, tmp_path: Path) -> None:
    """ADD-S from models and poses alone equals ours to 0.1 mm, under the data set's own numbers."""
    export_run(run, ["bop"], tmp_path / "out", ExportOptions())
    models = read_models(tmp_path / "out/bop/models")
    poses = read_poses(tmp_path / "out/bop/poses.csv")
    values = RunValues.load(RunFolder(run, force=False))
    assert {key[:2] for key in poses} == {(48, 1031)}
    assert (48, 1031, 14) in poses

    assert values.surfaces is not None
    mug = values.surfaces.by_name["mug"]
    own = trimesh.Trimesh(mug.vertices_m, mug.faces)
    expected = add_s_m(model_points(own), TRUE_POSE, FOUND_POSE)
    points = np.asarray(trimesh.sample.sample_surface(models[14], 20_000, seed=0)[0])
    true_from_model = TRUE_POSE @ np.linalg.inv(FOUND_POSE) @ poses[48, 1031, 14]
    apart, _ = KDTree(trimesh.transform_points(points, poses[48, 1031, 14])).query(
        trimesh.transform_points(points, true_from_model)
    )
    assert apart.mean() == pytest.approx(expected, abs=1e-4)
    middle = np.zeros(3) if mug.learned else own.bounds.mean(axis=0)
    np.testing.assert_allclose(models[14].bounds.mean(axis=0), middle, atol=1e-6)


@pytest.fixture
def two_mugs(parsed_run: RunValues, tmp_path: Path) -> Path:
    """A run in which two mugs were found, learned ones off the origin of their grid; a can was not."""
    body = trimesh.creation.box((0.1, 0.06, 0.08)).apply_translation([0.2, 0.1, 0.04])
    surface = SceneSurface(
        vertices_m=np.asarray(body.vertices), faces=np.asarray(body.faces, np.int64), learned=True
    )
    assert parsed_run.scene is not None
    names = ("mug", "mug_2", "can")
    numbers = DatasetNumbers(object_ids={"mug": 2, "mug_2": 2, "can": 1})
    values = replace(
        parsed_run,
        surfaces=Surfaces(dict.fromkeys(names, surface), numbers),
        scene=replace(parsed_run.scene, names=np.array(names)),
    )
    return write_run(tmp_path / "run", values)


def read_rows(path: Path) -> list[tuple[int, list[float]]]:
    """obj_id and t in metres of every row of poses.csv."""
    with path.open() as file:
        return [
            (int(row["obj_id"]), [float(value) / 1000 for value in row["t"].split()])
            for row in csv.DictReader(file)
        ]


def test_copies_of_a_shape_are_one_model_with_several_poses(two_mugs: Path, tmp_path: Path) -> None:
    """Each of the model's own frame, whose origin is in the middle."""
    export_run(two_mugs, ["bop"], tmp_path / "out", ExportOptions())
    assert sorted(read_models(tmp_path / "out/bop/models")) == [1, 2]
    assert json.loads((tmp_path / "out/bop/ids.json").read_text()) == {"can": 1, "mug": 2}
    rows = read_rows(tmp_path / "out/bop/poses.csv")
    assert [number for number, _ in rows] == [2, 2]
    np.testing.assert_allclose([place for _, place in rows], [[0.2, 0.1, 0.64], [0.2, 0.1, 0.74]], atol=1e-6)
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert sorted(manifest["shapes"]) == ["can", "mug"]


@pytest.mark.parametrize(
    ("ids", "numbers"), [({"mug": 1}, {"mug": 1, "can": 2}), ({"can": 7}, {"mug": 2, "can": 7})]
)
def test_ids_of_some_objects_leave_the_others_theirs(
    two_mugs: Path, tmp_path: Path, ids: dict[str, int], numbers: dict[str, int]
) -> None:
    """The run's, or one that is left where another object was given it."""
    export_run(two_mugs, ["bop"], tmp_path / "out", ExportOptions(ids=ids))
    assert json.loads((tmp_path / "out/bop/ids.json").read_text()) == numbers
    assert [number for number, _ in read_rows(tmp_path / "out/bop/poses.csv")] == [numbers["mug"]] * 2


def test_poses_have_the_ids_that_the_folder_holds(two_mugs: Path, tmp_path: Path) -> None:
    """Not the run's own; others that are asked for are refused, and nothing is written."""
    (tmp_path / "out/bop").mkdir(parents=True)
    held = {"mug": 5, "cup": 2}
    (tmp_path / "out/bop/ids.json").write_text(json.dumps(held))
    for number, line in ((2, "id 2 of mug is that of cup"), (9, "mug has id 5 there, and not 9")):
        with pytest.raises(PipelineError, match=line):
            export_run(two_mugs, ["bop"], tmp_path / "out", ExportOptions(ids={"mug": number}))
    assert not (tmp_path / "out/bop/models").exists()
    export_run(two_mugs, ["bop"], tmp_path / "out", ExportOptions())
    assert json.loads((tmp_path / "out/bop/ids.json").read_text()) == {"can": 1, **held}
    assert sorted(read_models(tmp_path / "out/bop/models")) == [1, 5]
    assert [number for number, _ in read_rows(tmp_path / "out/bop/poses.csv")] == [5, 5]


def test_a_learned_shape_is_not_taken_for_another_of_its_name(two_mugs: Path, tmp_path: Path) -> None:
    """That parse looked for, whose frame the poses are of. Where both are the same there is one model."""
    values, shape = RunValues.load(RunFolder(two_mugs)), block()
    learned = shape.surface()
    assert values.surfaces is not None
    same = SceneSurface(
        vertices_m=learned.vertices_m, faces=np.asarray(learned.triangles, np.int64), learned=True
    )
    surfaces = replace(values.surfaces, by_name=dict.fromkeys(values.surfaces.by_name, same))
    again = write_run(tmp_path / "again", replace(values, surfaces=surfaces))
    for run in (two_mugs, again):
        with open_run_folder(run, {"rec": "hash"}) as folder:
            folder.stage("learn/mug", ShapePrior.load, lambda: shape, settings={}, inputs={})

    with pytest.raises(PipelineError, match="two shapes named mug"):
        export_run(two_mugs, ["obj", "bop"], tmp_path / "out", ExportOptions())
    assert not (tmp_path / "out").exists()
    assert export_run(two_mugs, ["ply", "npz"], tmp_path / "out", ExportOptions())
    export_run(again, ["bop"], tmp_path / "again.bop", ExportOptions())
    assert sorted(read_models(tmp_path / "again.bop/bop/models")) == [1, 2]


def test_an_open_mesh_is_written_where_no_volume_is_needed(parsed_run: RunValues, tmp_path: Path) -> None:
    """As stl and for BOP; simulators, which need one, say so and write nothing, scene.glb neither."""
    sheet = SceneSurface(vertices_m=np.eye(3), faces=np.array([[0, 1, 2]], np.int64), learned=False)
    assert parsed_run.scene is not None
    surfaces = Surfaces(dict.fromkeys(parsed_run.scene.names, sheet))
    write_run(tmp_path / "run", replace(parsed_run, surfaces=surfaces))

    with pytest.raises(PipelineError, match="bounds no volume"):
        export_run(tmp_path / "run", ["glb", "urdf"], tmp_path / "out", ExportOptions())
    assert not (tmp_path / "out").exists()
    written = export_run(tmp_path / "run", ["stl", "bop"], tmp_path / "out", ExportOptions())
    assert len([path for path in written if path.suffix == ".stl"]) == len(surfaces.by_name)
    assert len([path for path in written if path.match("models/obj_*.ply")]) == len(surfaces.by_name)
