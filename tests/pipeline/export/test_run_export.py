"""`export` of runs that lack something, or in which two things have one name."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from click.testing import CliRunner, Result

from pipeline.cli import voxscene
from pipeline.fingerprints import file_hash
from pipeline.publishing.values import RunValues
from pipeline.room import RoomView
from pipeline.run_access import open_run_folder
from shapes.prior import ShapePrior
from tests.pipeline.export.test_model_export import block


def write_run(path: Path, room: RoomView | None, *shapes: str) -> Path:
    """A run with a room, or none, and a block by every name."""
    with open_run_folder(path, {"film.mcap": "0"}) as folder:
        if room is not None:
            folder.stage("room", RoomView.load, lambda: room, settings={}, inputs={})
        for name in shapes:
            folder.stage(f"learn/{name}", ShapePrior.load, block, settings={}, inputs={})
    return path


def export(source: Path, formats: str, out: Path, *options: str) -> Result:
    """The command."""
    command = ["export", str(source), "--format", formats, "-o", str(out), *options]
    return CliRunner().invoke(voxscene, command)


@pytest.mark.parametrize("formats", ["npz", "ply,npz"])
def test_a_run_without_learned_shapes_says_so(values: RunValues, tmp_path: Path, formats: str) -> None:
    """One line that names the command which makes them, and nothing is written."""
    told = export(write_run(tmp_path / "run", values.room), formats, tmp_path / "out")
    assert told.exit_code == 1
    assert "holds no learned shapes; make them with voxscene learn" in told.stderr
    assert told.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_projects_recordings_without_objects_are_passed_over(values: RunValues, tmp_path: Path) -> None:
    """What the others hold is written; where none holds anything, that is said."""
    project = tmp_path / "project"
    (project / "stages").mkdir(parents=True)
    write_run(project / "recordings" / "a", values.room)
    told = export(project, "npz", tmp_path / "none")
    assert told.exit_code == 1
    assert "holds anything for --format npz" in told.stderr

    write_run(project / "recordings" / "b", values.room, "mug")
    told = export(project, "npz,ply", tmp_path / "out")
    assert told.exit_code == 0, told.output
    assert (tmp_path / "out" / "a" / "room.ply").is_file()
    assert (tmp_path / "out" / "b" / "mug.npz").is_file()


def test_a_run_and_its_shape_may_have_one_name(values: RunValues, tmp_path: Path) -> None:
    """The manifest tells of both."""
    told = export(write_run(tmp_path / "mug", values.room, "mug"), "ply,obj", tmp_path / "out")
    assert told.exit_code == 0, told.output
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert [file["file"] for file in manifest["runs"]["mug"]["files"]] == ["room.ply", "mug.ply"]
    assert [file["file"] for file in manifest["shapes"]["mug"]["files"]] == ["mug.obj"]


def test_a_scene_stands_upright_beside_a_shape_that_stood_on_nothing(
    values: RunValues, tmp_path: Path
) -> None:
    """Its grid lies along the camera's axes: its z says nothing of the room."""
    told = export(write_run(tmp_path / "run", values.room, "mug"), "glb", tmp_path / "out")
    assert told.exit_code == 0, told.output

    scene = trimesh.load_scene(tmp_path / "out" / "scene.glb")
    for name in ("room", "mug"):
        turned = scene.graph.get(name)[0][:3, :3] @ [0.0, -1.0, 0.0]  # up in the only camera's image
        np.testing.assert_allclose(turned, [0.0, 1.0, 0.0], atol=1e-6)


def test_an_object_named_room_does_not_take_the_rooms_place(values: RunValues, tmp_path: Path) -> None:
    """One line says how both are exported."""
    run = write_run(tmp_path / "run", values.room, "room")
    told = export(run, "ply", tmp_path / "out")
    assert told.exit_code == 1
    assert "an object named room" in told.stderr
    assert export(run, "obj", tmp_path / "out").exit_code == 0


def test_options_of_shapes_say_nothing_of_a_scene(values: RunValues, tmp_path: Path) -> None:
    """Refused where ply is the scene of a run, taken where shapes are written beside it."""
    run = write_run(tmp_path / "run", values.room, "mug")
    for option in (["--units", "mm"], ["--shells"], ["--origin", "grid"]):
        told = export(run, "ply", tmp_path / "out", *option)
        assert (told.exit_code, f"{option[0]} is for " in told.stderr) == (2, True)
    assert export(run, "ply,stl", tmp_path / "out", "--units", "mm").exit_code == 0


@pytest.mark.parametrize("source", ["run", "run/shapes", "run/shapes/mug.npz"])
def test_ids_are_of_shapes_that_are_there(values: RunValues, tmp_path: Path, source: str) -> None:
    """A misspelt name is told, and not numbered as if it had not been given."""
    write_run(tmp_path / "run", values.room, "mug")
    ids = tmp_path / "ids.json"
    ids.write_text('{"mug": 14, "typo": 3}')
    told = export(tmp_path / source, "bop", tmp_path / "out", "--ids", str(ids))
    assert told.exit_code == 2
    assert "has no shape 'typo'" in told.stderr
    ids.write_text('{"mug": 14}')
    told = export(tmp_path / source, "bop", tmp_path / "out", "--ids", str(ids))
    assert told.exit_code == 0, told.output


def test_another_overlay_is_replaced_with_force_alone(
    parsed_run: RunValues, mug_file: Path, tmp_path: Path
) -> None:
    """As files of the other formats; the same again is no conflict."""
    with open_run_folder(tmp_path / "run", {mug_file.name: file_hash(mug_file)}) as folder:
        for name, value in {"objects": parsed_run.surfaces, "parse": parsed_run.scene}.items():
            assert value is not None
            folder.stage(name, type(value).load, lambda value=value: value, settings={}, inputs={})
    command = (tmp_path / "run", "overlay", tmp_path / "out", "--recording", str(mug_file))
    for _ in range(2):
        assert export(*command).exit_code == 0
    other = tmp_path / "out" / "overlay.svg"
    other.write_text("another")
    told = export(*command)
    assert told.exit_code == 1
    assert "overlay.svg is there and differs" in told.stderr
    assert other.read_text() == "another"
    assert export(*command, "--force").exit_code == 0
    assert "<svg" in other.read_text()
