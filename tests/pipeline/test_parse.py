"""`voxscene parse` finds objects on a table from their surfaces, and never from the truth."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import trimesh
from click.testing import CliRunner, Result
from scipy.special import expit

from pipeline import interface
from pipeline.cli import voxscene
from pipeline.config import Settings
from pipeline.errors import PipelineError
from pipeline.evaluation.object_poses import add_s_m, model_points
from pipeline.options import Common, RecordingSource
from pipeline.session import Session, open_session
from pipeline.stages.parse import _surfaces, drawn_shapes
from pipeline.surfaces import SceneSurface, Surfaces
from pipeline.synthesis.filming import film_table
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig, TableScene
from pipeline.synthesis.world import Part, RayCaster
from pipeline.synthesis.writing import write_recording
from recordings.truth import write_scene_truth
from recordings.types import Frame
from recordings.writer import RecordingWriter
from scene.config import ParseConfig
from scene.result import SceneResult
from shapes.prior import ShapePrior

SHAPES = ("box", "mug")
ABSENT = ("can",)
SHORT = ("-s", "parse.rounds=0", "-s", "parse.sweeps=18", "-s", "parse.chains=2")


@pytest.fixture(scope="module")
def table() -> SyntheticRecording:
    """One frame of a box and a mug on a table, by half the angle of most cameras: four times faster."""
    camera, path = CameraConfig(width=320, height=240, fx=554.0), PathConfig(frames=1, radius_m=0.8)
    scene = TableScene(room=RoomConfig(kind="none"), path=path, objects=2, camera=camera)
    return film_table({name: built_in_object(name) for name in SHAPES}, scene, 5)


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same objects as files, and others that are not on the table."""
    folder = tmp_path_factory.mktemp("meshes")
    for name in SHAPES + ABSENT:
        built_in_object(name).export(folder / f"{name}.ply")
    return folder


@pytest.fixture(scope="module")
def parsed(table: SyntheticRecording, meshes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run folder."""
    folder = tmp_path_factory.mktemp("parsed")
    write_recording(table, folder / "table.mcap")
    result = parse(folder / "table.mcap", meshes, folder / "run")
    assert result.exit_code == 0, result.output
    return folder / "run"


def parse(recording: Path, shapes: Path, run: Path, *more: str) -> Result:
    """The command."""
    arguments = ["parse", str(recording), "--shapes", str(shapes), "-o", str(run), "--quiet", *SHORT, *more]
    return CliRunner().invoke(voxscene, arguments)


def test_objects_stand_where_they_are(table: SyntheticRecording, parsed: Path) -> None:
    """Both within 5 mm ADD-S, on the table; what is not there is not found."""
    document = json.loads((parsed / "summary.json").read_text())["parse"]
    found = {one["name"]: np.array(one["camera_from_object"]) for one in document["objects"]}
    assert set(found) == set(SHAPES)
    camera_from_world = np.linalg.inv(table.trajectory.reference_from_camera[0])
    for true in table.truth.objects:
        points = model_points(trimesh.Trimesh(true.vertices_m, true.faces))
        assert add_s_m(points, camera_from_world @ true.world_from_object, found[true.shape]) < 0.005
    on_table = {edge["child"]: edge["probability"] for edge in document["graph"] if edge["parent"] == "table"}
    assert on_table["box"] > 0.5
    assert len((parsed / "poses.csv").read_text().splitlines()) == 1 + len(found)


def test_eval_poses_stops_at_the_truth_of_another_table(parsed: Path, tmp_path: Path) -> None:
    """Filmed at the same stamp: an error in one line, and no figures."""
    scene = TableScene(room=RoomConfig(kind="none"), path=PathConfig(frames=1, radius_m=0.6), objects=2)
    write_recording(
        film_table({name: built_in_object(name) for name in SHAPES}, scene, 4), tmp_path / "o.mcap"
    )
    result = CliRunner().invoke(voxscene, ["eval", "poses", str(parsed), "--truth", str(tmp_path / "o.mcap")])

    assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (1, "", 1), result.output
    assert "is not the recording of" in result.stderr


def test_eval_poses_tells_the_same_errors(table: SyntheticRecording, parsed: Path) -> None:
    """With the truth's own surfaces, and whether the parents are right."""
    recording = parsed.parent / "table.mcap"
    result = CliRunner().invoke(
        voxscene, ["eval", "poses", str(parsed), "--truth", str(recording), "--json"], catch_exceptions=False
    )
    document = json.loads(result.stdout)
    scene = SceneResult.load(parsed / "parse.npz")
    camera_from_world = np.linalg.inv(table.trajectory.reference_from_camera[0])
    for one, true in zip(document["objects"], table.truth.objects, strict=True):
        points = model_points(trimesh.Trimesh(true.vertices_m, true.faces))
        estimate = scene.camera_from_object[scene.names.tolist().index(true.shape)]
        exact = add_s_m(points, camera_from_world @ true.world_from_object, estimate)
        assert one["add_s_m"] == pytest.approx(exact, abs=1e-4)
    assert document["largest_m"] == max(one["add_s_m"] for one in document["objects"])
    assert document["accuracy"]["0.005"] == 1.0
    assert {one["name"] for one in document["objects"] if one["parent_right"]} >= {"box"}


def test_eval_poses_takes_the_camera_of_the_frame_that_was_parsed(
    table: SyntheticRecording, parsed: Path, tmp_path: Path
) -> None:
    """By its stamp: with --start it has another number in the recording, here by a frame before it."""
    (frame,), pose = list(table), table.trajectory.reference_from_camera[0]
    aside = pose.copy()
    aside[:3, 3] += 0.5
    with RecordingWriter(tmp_path / "longer.mcap", table.intrinsics) as writer:
        write_scene_truth(writer, table.truth, frame.time_ns)
        for one, camera in ((blank_before(frame), aside), (frame, pose)):
            writer.write_camera_pose(one.time_ns, camera)
            writer.write_depth(one)
    command = ["eval", "poses", str(parsed), "--truth", str(tmp_path / "longer.mcap"), "--json"]
    document = json.loads(CliRunner().invoke(voxscene, command, catch_exceptions=False).stdout)

    assert document["largest_m"] < 0.005


def test_eval_poses_leaves_out_what_was_not_looked_for(
    table: SyntheticRecording, parsed: Path, tmp_path: Path
) -> None:
    """Truth that tells of a bowl too: it is named, the others are judged."""
    bowl = replace(table.truth.objects[0], name="bowl", shape="bowl")
    told = replace(table.truth, objects=(*table.truth.objects, bowl))
    (frame,) = table
    with RecordingWriter(tmp_path / "more.mcap", table.intrinsics) as writer:
        write_scene_truth(writer, told, frame.time_ns)
        writer.write_camera_pose(frame.time_ns, table.trajectory.reference_from_camera[0])
        writer.write_depth(frame)
    command = ["eval", "poses", str(parsed), "--truth", str(tmp_path / "more.mcap")]
    result = CliRunner().invoke(voxscene, command, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "not looked for, and left out: bowl" in result.output
    document = json.loads(CliRunner().invoke(voxscene, [*command, "--json"]).stdout)
    assert sorted(one["name"] for one in document["objects"]) == sorted(SHAPES)


@pytest.mark.slow
def test_truth_and_recorded_poses_are_not_used(
    table: SyntheticRecording, meshes: Path, parsed: Path, tmp_path: Path
) -> None:
    """The same bytes without them."""
    bare = write_depth(tmp_path / "table.mcap", table, list(table))
    result = parse(bare, meshes, tmp_path / "run")
    assert result.exit_code == 0, result.output
    for name in ("parse.npz", "summary.json", "poses.csv"):
        assert (tmp_path / "run" / name).read_bytes() == (parsed / name).read_bytes()


@pytest.mark.slow
def test_the_python_interface_gives_the_bytes_of_the_command_line(
    meshes: Path, parsed: Path, tmp_path: Path
) -> None:
    """Same recording, shapes, seed and settings."""
    recording = interface.open_recording(parsed.parent / "table.mcap")
    scene = interface.parse(recording, meshes, rounds=0, sweeps=18, chains=2)
    scene.save(tmp_path / "parse.npz")
    assert (tmp_path / "parse.npz").read_bytes() == (parsed / "parse.npz").read_bytes()


def write_depth(path: Path, table: SyntheticRecording, frames: Sequence[Frame]) -> Path:
    """A recording of depth alone."""
    unit = 0.001 if table.sensor.in_millimetres else None
    with RecordingWriter(path, table.intrinsics, depth_unit_m=unit) as writer:
        for frame in frames:
            writer.write_depth(frame)
    return path


def blank_before(seen: Frame) -> Frame:
    """A frame that shows nothing."""
    return Frame(time_ns=seen.time_ns - 1_000_000, depth_m=np.zeros_like(seen.depth_m))


@pytest.mark.slow
def test_blank_first_frames_are_passed_over(
    table: SyntheticRecording, meshes: Path, parsed: Path, tmp_path: Path
) -> None:
    """The first frame that shows enough is parsed as if it stood alone."""
    (seen,) = table
    late = write_depth(tmp_path / "late.mcap", table, (blank_before(seen), seen))
    assert parse(late, meshes, tmp_path / "run").exit_code == 0
    found, alone = (
        json.loads((run / "summary.json").read_text())["parse"] for run in (tmp_path / "run", parsed)
    )
    assert found["frames"] == [1]
    assert found["objects"] == alone["objects"]


def test_a_recording_of_blank_frames_is_refused(
    table: SyntheticRecording, meshes: Path, tmp_path: Path
) -> None:
    """In one line."""
    (seen,) = table
    refused = parse(
        write_depth(tmp_path / "blank.mcap", table, [blank_before(seen)]), meshes, tmp_path / "run"
    )
    assert refused.exit_code == 1
    assert "no depth frame that shows enough" in refused.output


def test_mistakes_are_told_in_one_line(parsed: Path, meshes: Path, tmp_path: Path) -> None:
    """An unknown name, a frame past the end; a folder without shapes, none, a file, a run."""
    recording = parsed.parent / "table.mcap"
    (tmp_path / "empty").mkdir()
    for shapes, more, told in [
        (meshes, ("--objects", "cup"), "no shape 'cup'; there are box, can, mug"),
        (meshes, ("--frames", "7"), "no frame 7: it has 1, from 0 on"),
        (tmp_path / "empty", (), "holds no meshes"),
        (tmp_path / "nowhere", (), "no folder of shapes"),
        (recording, (), "is a file; name its folder, and the shape with --objects table"),
        (parsed, (), "is a run without learned shapes; make one: voxscene learn"),
    ]:
        result = parse(recording, shapes, tmp_path / "run", *more)
        assert result.exit_code == 1
        assert told in result.output
        assert "Traceback" not in result.output
    assert not (tmp_path / "run").exists()


def test_any_object_is_asked_for_over_the_settings_that_name_some(
    mug_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As those of an earlier run; without the option they hold."""
    asked: list[tuple[str, ...]] = []

    def stop(session: Session, shapes: Path, units: object, options: dict[str, Any], *_: object) -> None:
        del shapes, units
        asked.append(session.common.settings.section("parse", ParseConfig, options).objects)
        raise PipelineError("asked")

    monkeypatch.setattr("pipeline.stages.parse.parse_stage", stop)
    for more in (("--objects", "any"), (), ("--objects", "can")):
        parse(mug_file, tmp_path, tmp_path / "run", "-s", "parse.objects=['mug']", *more)
    assert asked == [(), ("mug",), ("can",)]


def voxel_shape(name: str) -> ShapePrior:
    """The shape of an object as it might be learned: sure inside and outside, a coin at the surface."""
    mesh, pitch = built_in_object(name), 0.006
    low, high = mesh.bounds
    shape = tuple(int(n) for n in np.ceil((high - low) / pitch) + 4)
    centres = low - 2 * pitch + (np.moveaxis(np.indices(shape), 0, -1) + 0.5) * pitch
    caster = RayCaster([Part(name=name, mesh=mesh, world_from_part=np.eye(4))])
    points = centres.reshape(-1, 3)
    inward_m = (caster.clearance_m(points) * np.where(caster.holds(points), 1, -1)).reshape(shape)
    return ShapePrior(
        phi=expit(inward_m / 0.0006).astype(np.float32),
        pitch_m=pitch,
        reference_from_grid=np.eye(4),
        seen_free=inward_m <= 0,
        seen_occupied=inward_m > 0,
        enclosed=np.zeros(shape, bool),
    )


@pytest.mark.slow
def test_learned_shapes_are_averaged_over_their_draws(
    table: SyntheticRecording, parsed: Path, tmp_path: Path
) -> None:
    """The box from its voxels, within 6 mm; how much the estimate varies, which meshes cannot tell."""
    (tmp_path / "shapes").mkdir()
    shape = voxel_shape("box")
    shape.save(tmp_path / "shapes" / "box.npz")
    recording = parsed.parent / "table.mcap"
    result = parse(recording, tmp_path / "shapes", tmp_path / "run", "--shape-samples", "2")
    assert result.exit_code == 0, result.output
    document = json.loads((tmp_path / "run" / "summary.json").read_text())["parse"]
    assert document["log_estimate_variance"] > 0
    assert 0 < document["acceptance"] < 1
    camera_from_world = np.linalg.inv(table.trajectory.reference_from_camera[0])
    true = next(one for one in table.truth.objects if one.shape == "box")
    mesh = built_in_object("box")
    camera_from_grid = np.array(document["objects"][0]["camera_from_object"])
    camera_from_mesh = camera_from_grid @ trimesh.transformations.translation_matrix(
        2 * shape.pitch_m - mesh.bounds[0]
    )
    points = model_points(mesh)
    assert add_s_m(points, camera_from_world @ true.world_from_object, camera_from_mesh) < 0.006


def test_copies_of_learned_shapes_are_drawn_from_their_shape(tmp_path: Path) -> None:
    """And each copy has draws of its own."""
    voxel_shape("box").save(tmp_path / "box.npz")
    surface = SceneSurface(vertices_m=np.eye(3), faces=np.array([[0, 1, 2]]))
    surfaces = Surfaces({"box": surface, "box_2": surface})
    key = jax.random.key(0)
    first, second = drawn_shapes(tmp_path, surfaces, key, ParseConfig(shape_samples=2))
    assert len(first) == len(second) > 1
    assert not np.array_equal(first[0][0], second[0][0])
    assert drawn_shapes(tmp_path, surfaces, key, ParseConfig()) == [[], []]


def test_copies_have_the_id_of_their_shape(mug_file: Path, tmp_path: Path) -> None:
    """Ids of shapes are the same whether copies are asked for or not, also those named like copies."""
    (tmp_path / "meshes").mkdir()
    for name in ("box", "box_2", "mug"):
        built_in_object("box").export(tmp_path / "meshes" / f"{name}.ply")
    common = Common(as_json=False, quiet=True, settings=Settings.read(None, ()))
    source = RecordingSource(path=mug_file, said={})
    found = []
    for names in (("mug:3", "box_2"), ("mug",)):
        with open_session(common, source, tmp_path / "run") as session:
            found.append(_surfaces(session, tmp_path / "meshes", None, names, {}, 1).value)
    copies, alone = found

    assert copies.object_ids == {"mug": 3, "mug_2": 3, "mug_3": 3, "box_2": 2}
    assert copies.shape_names == {"mug": "mug", "mug_2": "mug", "mug_3": "mug", "box_2": "box_2"}
    assert alone.object_ids == {"mug": 3}


def test_meshes_have_no_shape_samples(parsed: Path, meshes: Path, tmp_path: Path) -> None:
    """One line says that they need learned shapes."""
    result = parse(parsed.parent / "table.mcap", meshes, tmp_path / "run", "--shape-samples", "2")
    assert result.exit_code == 1
    assert "shape samples need learned shapes" in result.output
    assert "Traceback" not in result.output
