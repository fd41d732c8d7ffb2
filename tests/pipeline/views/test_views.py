"""The views of a run hold what they say, and a picture can be taken without a screen."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import rerun as rr
import trimesh
from click.testing import CliRunner
from PIL import Image
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from pipeline.cli import voxscene
from pipeline.errors import PipelineError
from pipeline.evaluation.trajectories import compared
from pipeline.evaluation.truth import RecordedTruth
from pipeline.publishing.messages import write_messages
from pipeline.publishing.summary import summary_of
from pipeline.publishing.trajectory_files import tum_lines
from pipeline.publishing.values import RunValues
from pipeline.surfaces import SceneSurface, Surfaces
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.views import truth_view
from pipeline.views.blueprint import room_eye
from pipeline.views.report import report_markdown
from pipeline.views.rrd import write_rrd
from pipeline.views.scene_view import _boxes, _mesh, _node_places, _places_on_edges, graph_bounds
from pipeline.views.screenshot import SOFTWARE_DRIVER, frames_in, take_screenshot
from pipeline.views.truth_view import _object_levels, _objects_truth, truth_of
from pipeline.views.viewer import open_viewer, rrd_of_mcap, rrds_of
from recordings.dataset_numbers import DatasetNumbers
from recordings.truth import SceneTruth, TrueObject
from recordings.types import Trajectory
from slam.result import SlamResult
from tests.pipeline.publishing.test_any_value import some_frames
from tests.scene.results import scene_result

rr.set_strict_mode(True)


def rows_of(rrd: Path) -> dict[str, int]:
    """Rows by entity, read back by Rerun."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(rrd).stream():
        rows[str(chunk.entity_path)] = rows.get(str(chunk.entity_path), 0) + chunk.num_rows
    return {path: count for path, count in rows.items() if not path.startswith("/__properties")}


def test_the_rrd_holds_every_part_of_the_run(values: RunValues, tmp_path: Path) -> None:
    """By entity, read back by Rerun."""
    write_rrd(tmp_path / "run.rrd", "mug", values)
    rows = rows_of(tmp_path / "run.rrd")

    expected = {f"/plots/{plot}": 6 for plot in ("position", "rotation", "hypotheses", "evidence")}
    expected |= {f"/images/{image}": 6 for image in ("depth", "rendered", "difference", "colour")}
    expected |= {f"/world/path/{part}": 1 for part in ("mean", "drawn", "views", "uncertainty")}
    expected |= {"/world/camera": 6, "/world/room": 1, "/legend": 1, "/report": 1}
    expected |= {f"/shapes/mug/{part}": 1 for part in ("surface_by_state", "voxels", "never_seen")}
    assert {path: rows.get(path, 0) >= count for path, count in expected.items()} == dict.fromkeys(
        expected, True
    )
    assert [path.name for path in tmp_path.iterdir()] == ["run.rrd"]


def test_a_parsed_scene_is_drawn(parsed_run: RunValues, tmp_path: Path) -> None:
    """Found objects in the room, the graph, and a line for each object."""
    write_rrd(tmp_path / "run.rrd", "table", parsed_run)
    entities = {str(chunk.entity_path) for chunk in RrdReader(tmp_path / "run.rrd").stream()}

    parts = {f"/world/objects/mug/{part}" for part in ("surface", "samples", "uncertainty", "pole", "label")}
    assert parts | {"/world/objects/box/surface", "/graph", "/presence"} <= entities
    assert "/world/objects/can/surface" not in entities
    report = report_markdown(parsed_run, summary_of(parsed_run))
    assert "| mug | 0.99 | +- 2 mm? | +- 0.1 deg | 100% | box 90% |" in report
    assert "| can | 0.10 | | | | not found |" in report
    assert "not converged: R-hat" in report


def test_a_single_frame_shows_its_images(values: RunValues, parsed_run: RunValues, tmp_path: Path) -> None:
    """A parse without a trajectory: depth seen, depth of the objects, and the difference, in its frame."""
    assert values.room is not None
    assert parsed_run.scene is not None
    one = {name: getattr(values.room, name)[2:3] for name in ("frames", "times_ns", "depth_mm")}
    colour = None if values.room.view_rgb is None else values.room.view_rgb[2:3]
    room = replace(values.room, **one, view_rgb=colour)
    write_rrd(tmp_path / "run.rrd", "table", replace(parsed_run, slam=None, room=room))

    rows = {str(chunk.entity_path): chunk.num_rows for chunk in RrdReader(tmp_path / "run.rrd").stream()}
    assert {path: rows[f"/images/{path}"] for path in ("depth", "rendered", "difference")} == dict.fromkeys(
        ("depth", "rendered", "difference"), 1
    )
    assert frames_in(tmp_path / "run.rrd") == [2, 2]
    with pytest.raises(PipelineError, match="has no frame 0: it shows 2 to 2"):
        take_screenshot([tmp_path / "run.rrd"], tmp_path / "a.png", (800, 500), 0)


def test_edges_are_drawn_sharp_and_round_sides_smooth() -> None:
    """A box has its own normals on each of six faces; a ball one normal at each vertex."""
    box, ball = trimesh.creation.box(), trimesh.creation.icosphere()
    counts = []
    for one in (box, ball):
        surface = SceneSurface(vertices_m=np.asarray(one.vertices), faces=np.asarray(one.faces))
        normals = _mesh(surface, (200, 0, 0)).vertex_normals
        assert normals is not None
        counts.append(len(normals.as_arrow_array()))

    assert counts == [6 * 4, len(ball.vertices)]


def test_a_photograph_shows_no_depth_that_was_not_measured(
    values: RunValues, parsed_run: RunValues, tmp_path: Path
) -> None:
    """Colour and what was found in it alone, looked at from near by, not through the camera."""
    assert values.room is not None
    assert values.room.view_rgb is not None
    one = {name: getattr(values.room, name)[:1] for name in ("frames", "times_ns", "view_rgb")}
    none = {name: getattr(values.room, name)[:0] for name in ("points_m", "normals")}
    room = replace(values.room, **one, **none, depth_mm=0 * values.room.depth_mm[:1], rgb=None)
    photograph = replace(parsed_run, slam=None, room=room)
    write_rrd(tmp_path / "run.rrd", "photograph", photograph)

    entities = {str(chunk.entity_path) for chunk in RrdReader(tmp_path / "run.rrd").stream()}
    shown = {entity for entity in entities if entity.startswith("/images/")}
    assert shown == {"/images/rendered", "/images/colour"}
    eye = room_eye(photograph)
    assert eye is not None
    assert eye.position[2] > 0.1


def test_runs_keep_their_views_to_themselves(tmp_path: Path) -> None:
    """Rerun keeps one blueprint for each application, and merges recordings of one id."""
    empty = RunValues(slam=None, room=None, shapes={})
    for identity in ("a1", "b2"):
        write_rrd(tmp_path / f"{identity}.rrd", "table", empty, identity)
    stores = [RrdReader(tmp_path / f"{identity}.rrd").recordings()[0] for identity in ("a1", "b2")]

    assert len({one.application_id for one in stores}) == 2
    assert len({one.recording_id for one in stores}) == 2


def test_paths_that_differ_are_told(true_trajectory: SlamResult) -> None:
    """The third particle stands a metre aside in the last frame; where all agree, nothing is said."""
    draws = true_trajectory.draws.copy()
    draws[2, -1, 4] += 1.0
    undecided = replace(true_trajectory, draws=draws)

    agreed, told = (
        report_markdown(run, summary_of(run))
        for run in (RunValues(slam=slam, room=None, shapes={}) for slam in (true_trajectory, undecided))
    )

    assert undecided.path_probabilities == pytest.approx([0.8, 0.2])
    assert "2 paths explain what was seen**, with 80%, 20%" in told
    assert "paths explain" not in agreed
    lost = replace(undecided, lost=np.arange(len(undecided)) == len(undecided) - 1)
    assert lost.path_probabilities == pytest.approx([1.0])


def test_a_map_that_may_not_have_been_found_is_told(true_trajectory: SlamResult) -> None:
    """In the view, and in summary.json for the terminal; of less than half a percent nothing is said."""
    for probability, share in ((0.514, "51%"), (0.004, None)):
        slam = replace(true_trajectory, undiscovered=np.asarray(probability))
        run = RunValues(slam=slam, room=None, shapes={})
        summary = summary_of(run)
        assert summary["slam"]["undiscovered_probability"] == probability
        for told in (report_markdown(run, summary), " ".join(summary["slam"]["warnings"])):
            assert ("may have missed the true map" in told) == (share is not None)
            assert share is None or share in told


def test_the_graph_stands_as_the_scene_does(parsed_run: RunValues) -> None:
    """The table below the box, which is below the mug; labels of one level do not cover each other."""
    scene = parsed_run.scene
    assert scene is not None
    mug, box, table = _node_places(scene, ["mug", "box", "table"])
    assert mug[1] < box[1] < table[1]

    names = np.array([f"a_rather_long_name_{index}" for index in range(6)])
    flat = scene_result(names.tolist(), np.tile(np.eye(4), (6, 1, 1)), [6] * 6)
    places = _node_places(flat, [*names, "table"])[:6]
    across = np.abs(places[:, None] - places[None])[np.triu_indices(6, 1)]
    assert (places[:, 1] < 0).all()
    assert ((across[:, 0] > 7 * len(names[0])) | (across[:, 1] > 30)).all()


@pytest.mark.parametrize("name", ["can", "a_rather_long_name"])
def test_no_box_of_the_graph_covers_another(name: str) -> None:
    """Of six things on a table and their probabilities; all lie within the bounds of the view."""
    labels = [*(f"{name}_{index}" for index in range(6)), "table"]
    flat = scene_result(labels[:-1], np.tile(np.eye(4), (6, 1, 1)), [6] * 6)
    places = _node_places(flat, labels)
    nodes = _boxes(places, labels)
    told = _places_on_edges([(place, places[-1]) for place in places[:-1]], ["100%"] * 6, nodes)
    boxes = np.concatenate([nodes, _boxes(told, ["100%"] * 6)])

    cover = ((boxes[:, None, 0] < boxes[:, 1]) & (boxes[:, 0] < boxes[:, None, 1])).all(axis=-1)
    assert not np.triu(cover, 1).any()
    low, high = graph_bounds(flat)
    assert (boxes[:, 0] > low).all()
    assert (boxes[:, 1] < high).all()


def test_a_run_without_values_has_views_too(tmp_path: Path) -> None:
    """The report alone."""
    write_rrd(tmp_path / "run.rrd", "empty", RunValues(slam=None, room=None, shapes={}))

    assert (tmp_path / "run.rrd").stat().st_size > 0


def test_the_report_tells_the_figures(values: RunValues) -> None:
    """In millimetres."""
    text = report_markdown(values, summary_of(values))

    assert "6 frames over" in text
    assert "none lost" in text
    assert "position +- 1.7 mm (median), 1.7 mm in frame 0, if only noise and distortion" in text
    assert "| mug | 5 x 5 x 5 | 5 | 0% | 14% | 86% |" in text


def test_up_is_the_worlds(filmed_mug: SyntheticRecording, values: RunValues) -> None:
    """Found from level cameras to a degree, though all look down; a shape's support is better."""
    reference_from_world = np.linalg.inv(filmed_mug.trajectory.reference_from_camera[0])
    alone = RunValues(slam=values.slam, room=values.room, shapes={})

    assert alone.up @ reference_from_world[:3, 2] > np.cos(np.radians(1))
    small = values.shapes["mug"]
    upright = np.eye(4)
    upright[:3, :3] = Rotation.align_vectors([alone.up], [[0.0, 0.0, 1.0]])[0].as_matrix()
    standing = replace(alone, shapes={"mug": replace(small, reference_from_grid=upright)})
    np.testing.assert_allclose(standing.up, upright[:3, 2])
    assert values.up.tolist() == alone.up.tolist()  # whose grid lies along the camera's axes


def test_the_views_are_made_again_from_the_mcap_alone(
    values: RunValues, parsed_run: RunValues, tmp_path: Path
) -> None:
    """Its attachments are the values: the same entities with as many rows."""
    whole = replace(parsed_run, room=values.room, shapes=values.shapes)
    parts = {"slam.npz": whole.slam, "room.npz": whole.room, "parse.npz": whole.scene}
    parts |= {"objects.npz": whole.surfaces, "shapes/mug.npz": whole.shapes["mug"]}
    (tmp_path / "shapes").mkdir()
    for name, value in parts.items():
        assert value is not None
        value.save(tmp_path / name)
    write_messages(tmp_path / "run.mcap", whole, {}, {name: tmp_path / name for name in parts})
    write_rrd(tmp_path / "whole.rrd", "table", whole)

    again = rrd_of_mcap(tmp_path / "run.mcap")

    assert rows_of(again) == rows_of(tmp_path / "whole.rrd")
    write_messages(tmp_path / "bare.mcap", whole, {})
    with pytest.raises(PipelineError, match="holds no values of a run"):
        rrd_of_mcap(tmp_path / "bare.mcap")


def test_review_names_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No run, a run of another version, one that was cut off, no screen."""
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    result = CliRunner().invoke(voxscene, ["review", str(tmp_path)])

    assert result.exit_code == 1
    assert "holds no run" in result.stderr
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "slam.json").write_text('{"fingerprint": "of an older version"}')
    assert "another version" in CliRunner().invoke(voxscene, ["review", str(tmp_path)]).stderr
    (tmp_path / "stages" / "slam.json").rename(tmp_path / "stages" / "inputs.json")
    assert "no finished stage" in CliRunner().invoke(voxscene, ["review", str(tmp_path)]).stderr
    assert rrds_of(tmp_path / "none") == []
    with pytest.raises(PipelineError, match=r"no screen here; .* --web, take a picture with --screenshot"):
        open_viewer([tmp_path / "run.rrd"])


@pytest.mark.parametrize("code", [0, 3])
def test_a_viewer_that_fails_is_told(code: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No other machine reaches it; what it showed stands in the document."""
    viewer = tmp_path / "rerun"
    viewer.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/said\nexit {code}\n')
    viewer.chmod(0o755)
    rrd = tmp_path / "run.rrd"
    monkeypatch.setenv("DISPLAY", ":9")
    monkeypatch.setattr("pipeline.views.viewer._program", lambda: viewer)
    monkeypatch.setattr("pipeline.views.viewer.rrds_of", lambda *_, **__: [rrd])
    told = CliRunner().invoke(voxscene, ["review", str(tmp_path), "--json"])

    assert (tmp_path / "said").read_text().split() == ["--bind", "127.0.0.1", str(rrd)]
    if code:
        assert (told.exit_code, told.stdout) == (1, "")
        assert "viewer ended with code 3" in told.stderr
    else:
        assert json.loads(told.stdout) == {"shown": [str(rrd)]}


def test_a_picture_of_a_project_tells_whose_it_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """And how to take one of another recording; of a single run there is nothing to choose."""
    rrds = [tmp_path / "recordings" / name / "run.rrd" for name in ("can", "table")]
    monkeypatch.setattr("pipeline.views.screenshot.take_screenshot", lambda *_: None)
    monkeypatch.setattr("pipeline.views.viewer.rrds_of", lambda *_, **__: rrds)
    command = ["review", str(tmp_path), "--screenshot", str(tmp_path / "a.png")]
    first, second = CliRunner().invoke(voxscene, command).stdout.splitlines()

    assert first.endswith(f"shows {rrds[1].parent}")
    assert f"others here: can; of one of them: voxscene review {rrds[0].parent} --screenshot" in second
    assert json.loads(CliRunner().invoke(voxscene, [*command, "--json"]).stdout)["shows"] == str(
        rrds[1].parent
    )
    monkeypatch.setattr("pipeline.views.viewer.rrds_of", lambda *_, **__: rrds[:1])
    assert CliRunner().invoke(voxscene, command).stdout.count("\n") == 1


def test_a_picture_of_a_run_mcap_tells_its_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its folder may hold many."""
    monkeypatch.setattr("pipeline.views.screenshot.take_screenshot", lambda *_: None)
    monkeypatch.setattr("pipeline.views.viewer.rrd_of_mcap", lambda mcap: mcap.with_suffix(".rrd"))
    command = ["review", "kitchen.mcap", "--from-mcap", "--screenshot", str(tmp_path / "a.png")]

    assert CliRunner().invoke(voxscene, command).stdout.endswith(" shows kitchen.mcap\n")


@pytest.mark.slow
@pytest.mark.skipif(not SOFTWARE_DRIVER.exists(), reason="mesa-vulkan-drivers is not installed")
def test_a_picture_is_taken_without_a_screen(values: RunValues, tmp_path: Path) -> None:
    """Of the size that was asked for, with many colours in it."""
    write_rrd(tmp_path / "run.rrd", "mug", values)
    take_screenshot([tmp_path / "run.rrd"], tmp_path / "run.png", (800, 500), 3)

    picture = Image.open(tmp_path / "run.png")
    assert picture.size == (800, 500)
    assert len(picture.convert("RGB").getcolors(maxcolors=1 << 20) or []) > 1000


def test_the_truth_is_shown_beside_a_run(
    values: RunValues, filmed_mug: SyntheticRecording, tmp_path: Path
) -> None:
    """Of a run that is right no error, and the truth in regions of all levels; of a shifted one in none."""
    assert values.slam is not None
    poses = values.slam.mean[0] @ filmed_mug.trajectory.reference_from_camera
    (tmp_path / "true.tum").write_text(tum_lines(values.slam.times_ns, poses))
    mean = values.slam.mean.copy()
    mean[1:, :3, 3] += 0.1
    shifted = replace(values, slam=replace(values.slam, mean=mean))

    right, wrong = (truth_of(one, tmp_path / "true.tum") for one in (values, shifted))

    np.testing.assert_allclose(right.errors_m, 0, atol=1e-6)
    np.testing.assert_allclose(wrong.errors_m[1:], 0.1 * np.sqrt(3), atol=1e-6)
    assert right.levels["camera"].max() < 1e-3
    assert wrong.levels["camera"].min() > 0.99
    write_rrd(tmp_path / "run.rrd", "run", values, truth=right)
    rows = rows_of(tmp_path / "run.rrd")
    assert rows["/plots/error"] >= 6
    assert {"/world/truth/path", "/calibration"} <= set(rows)
    later = replace(values.slam, times_ns=values.slam.times_ns + 10**12)
    with pytest.raises(PipelineError, match="fewer than two frames"):
        truth_of(replace(values, slam=later), tmp_path / "true.tum")


def test_objects_where_they_were_told_lie_in_every_region(parsed_run: RunValues) -> None:
    """And half a metre away in none, to a part in a hundred."""
    scene, surfaces = parsed_run.scene, parsed_run.surfaces
    assert scene is not None
    assert surfaces is not None
    away = np.eye(4)
    away[0, 3] = 0.5
    where = scene.found_poses

    assert _object_levels(scene, surfaces, where).max() < 1e-6
    assert _object_levels(scene, surfaces, [(name, away @ pose) for name, pose in where]).min() > 0.99


def test_objects_of_a_single_frame_have_a_truth(
    parsed_run: RunValues, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Where slam ran on it alone, as in a project, there is no error of the camera to show.

    What was looked for and not found is shown where it is, too.
    """
    assert parsed_run.slam is not None
    assert parsed_run.scene is not None
    slam = some_frames(parsed_run.slam, slice(1))
    single = replace(parsed_run, slam=slam, scene=replace(parsed_run.scene, frames=np.array([0])))
    assert single.scene is not None
    true = TrueObject(name="cup", shape="mug", world_from_object=parsed_run.scene.camera_from_object[0])
    known = SimpleNamespace(scene=SceneTruth(objects=(true,)), camera_from_world=lambda _: np.eye(4))
    monkeypatch.setattr(truth_view, "recorded_scene_truth", lambda _: known.scene)
    monkeypatch.setattr(truth_view, "RecordedTruth", lambda *_: known)
    truth = truth_of(single, tmp_path / "true.mcap")

    assert list(truth.levels) == ["objects"]
    missed = replace(single.scene, presence=np.zeros(len(single.scene.names)))
    none_found = truth_of(replace(single, scene=missed), tmp_path / "true.mcap")
    assert (list(none_found.objects), list(none_found.levels)) == (["cup"], [])
    write_rrd(tmp_path / "missed.rrd", "run", replace(single, scene=missed), truth=none_found)
    assert "/world/truth/objects/cup" in rows_of(tmp_path / "missed.rrd")
    write_rrd(tmp_path / "run.rrd", "run", single, truth=truth)
    assert "/world/truth/objects/cup" in rows_of(tmp_path / "run.rrd")
    with pytest.raises(PipelineError, match="the path is of one frame"):
        compared(slam.times_ns, Trajectory(times_ns=slam.times_ns, reference_from_camera=slam.mean))


def test_objects_of_one_shape_are_each_beside_the_truth_that_is_nearest(parsed_run: RunValues) -> None:
    """Two mugs, the truth in another order than they were found; a third that was not found counts not."""
    assert parsed_run.scene is not None
    assert parsed_run.surfaces is not None
    names = ["mug", "mug_2", "can"]
    mug = parsed_run.surfaces.by_name["mug"]
    surfaces = Surfaces(
        dict.fromkeys(names, mug), DatasetNumbers(object_ids=dict(zip(names, (1, 1, 2), strict=True)))
    )
    scene = replace(parsed_run.scene, names=np.array(names))
    far = np.eye(4)
    far[0, 3] = 0.5
    (_, first), (_, second) = scene.found_poses
    known = cast(
        RecordedTruth,
        SimpleNamespace(
            scene=SceneTruth(
                objects=tuple(
                    TrueObject(name=f"mug {number}", shape="mug", world_from_object=pose)
                    for number, pose in enumerate((far, second, first))
                )
            ),
            camera_from_world=lambda _: np.eye(4),
        ),
    )
    true = _objects_truth(0, surfaces, known)

    assert list(true) == ["mug 0", "mug 1", "mug 2"]
    levels = _object_levels(scene, surfaces, list(true.values()))
    assert len(levels) == 2
    assert levels.max() < 1e-6
