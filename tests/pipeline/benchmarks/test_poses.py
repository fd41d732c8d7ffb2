"""The table of `bench poses`: who is judged on what, and that peers find an object alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pipeline.benchmarks.pose_tables import VISIBLE, Table, make_table, observed_points

from pipeline.benchmarks.learned_objects import true_object
from pipeline.benchmarks.pose_figures import Judged, append_rows, pose_figures, read_rows
from pipeline.benchmarks.pose_presence import Reported, presence_figures
from pipeline.benchmarks.poses import PoseBench
from pipeline.errors import PipelineError
from pipeline.evaluation.object_poses import add_s_m, model_points
from pipeline.peers.registration import Model, settings
from pipeline.synthesis.objects import built_in_object
from scene.config import ParseConfig
from tests.scene.results import scene_result

SHAPES = ("bracket", "mug", "bottle")


@pytest.fixture(scope="module")
def meshes() -> dict[str, trimesh.Trimesh]:
    """Three objects."""
    return {name: built_in_object(name) for name in SHAPES}


@pytest.fixture(scope="module")
def table(meshes: dict[str, trimesh.Trimesh]) -> Table:
    """They, one of them stacked."""
    return make_table(meshes, 3, 1)


def test_tables_repeat_and_differ(meshes: dict[str, trimesh.Trimesh], table: Table) -> None:
    """The same number gives the same depth, and a third of the objects are stacked."""
    again, other = make_table(meshes, 3, 1), make_table(meshes, 3, 2)
    np.testing.assert_array_equal(table.frame.depth_m, again.frame.depth_m)
    assert (table.frame.depth_m != other.frame.depth_m).any()
    assert sum(one.parent != "table" for one in table.recording.truth.objects) >= 1


def test_the_truth_is_judged_perfect_and_hidden_objects_are_not(
    meshes: dict[str, trimesh.Trimesh], table: Table
) -> None:
    """Poses and parents from the truth itself."""
    bench = PoseBench(meshes, 3, 0, true_object)
    truth = table.recording.truth.objects
    names = [*(one.name for one in truth), "table"]
    scene = scene_result(
        [one.shape for one in truth],
        [table.camera_from_world @ one.world_from_object for one in truth],
        [names.index(str(one.parent)) for one in truth],
    )
    judged = bench._judged(1, table, "ours", scene, 1.0)
    seen = [one for one in truth if (one.visible_fraction or 0) >= VISIBLE]
    assert [one.error_m for one in judged] == pytest.approx([0] * len(seen), abs=1e-9)
    assert all(one.parent_right in (True, None) for one in judged)
    nothing = bench._judged(1, table, "ours", replace(scene, presence=np.zeros(3)), 1.0)
    assert {one.error_m for one in nothing} == {1.0}


def test_true_masks_hold_the_object_alone(meshes: dict[str, trimesh.Trimesh], table: Table) -> None:
    """Masked points lie on the object; unmasked ones hold them all."""
    everything = observed_points(table, meshes, masked=False)[0]
    masked = observed_points(table, meshes, masked=True)
    for one, points in zip(table.recording.truth.objects, masked, strict=True):
        inside = np.linalg.inv(table.camera_from_world @ one.world_from_object)
        own = points @ inside[:3, :3].T + inside[:3, 3]
        low, high = meshes[one.shape].bounds
        assert ((own > low - 0.013) & (own < high + 0.013)).all()
        assert len(points) <= len(everything)


@pytest.mark.parametrize("peer", ["fpfh", "icp24"])
def test_a_peer_finds_a_whole_object(peer: str) -> None:
    """Its own points, turned: within 5 mm with its best setting."""
    mesh = built_in_object("bracket")
    model = Model.of(mesh)
    pose = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.0], [0, 0, 1, 0.8], [0, 0, 0, 1.0]])
    observed = model.points_m @ pose[:3, :3].T + pose[:3, 3]
    points = model_points(mesh)
    errors = [add_s_m(points, pose, register(model, observed)) for register in settings()[peer].values()]
    assert min(errors) < 0.005


@pytest.fixture
def judged() -> list[Judged]:
    """Two tables of one method."""
    right = Judged(
        method="ours",
        setting="",
        table=0,
        shape="mug",
        error_m=0.002,
        visible_fraction=1.0,
        stacked=False,
        flush=True,
        parent_right=True,
        seconds=1.0,
    )
    wrong = replace(right, error_m=0.015, stacked=True, parent_right=False)
    missing = replace(right, error_m=1.0, stacked=True, flush=False, parent_right=None, table=1, seconds=3.0)
    return [right, wrong, missing]


def test_rows(judged: list[Judged]) -> None:
    """Stacked and not, parents by the kind of rest, seconds a table and not an object."""
    document = pose_figures(judged)
    assert document["tables"] == 2
    figures = document["methods"]["ours"]
    assert figures["rows"]["all"]["accuracy"]["0.01"] == pytest.approx(1 / 3)
    assert figures["rows"]["stacked"]["objects"] == 2
    assert figures["edges"]["flush"] == {"rests": 2, "right": 0.5}
    assert figures["edges"]["other"] == {"rests": 0, "right": None}
    assert (figures["seconds_median"], figures["seconds_most"]) == (2.0, 3.0)


def test_rows_are_kept_between_runs(judged: list[Judged], tmp_path: Path) -> None:
    """A file that grows table by table gives back every row; another file is refused by name."""
    path = tmp_path / "poses.csv"
    assert read_rows(path) == []
    append_rows(path, judged[:2])
    append_rows(path, judged[2:])
    assert read_rows(path) == judged
    path.write_text("error_m\nfar\n")
    with pytest.raises(PipelineError, match=r"poses\.csv"):
        read_rows(path)


def test_presence_is_counted_against_what_is_there() -> None:
    """Absent or misplaced but found is false; there but not found is missed; each bin has its own share."""

    def said(presence: float, there: bool, error_m: float = np.inf) -> Reported:
        return Reported(shape="mug", presence=presence, there=there, error_m=error_m)

    figures = presence_figures(
        [
            said(1.0, True, 0.001),
            said(0.99, False),
            said(0.7, True, 0.1),
            said(0.4, True, 1.0),
            said(0.01, False),
        ]
    )
    assert (figures["asked"], figures["absent"]) == (5, 2)
    assert (figures["false"], figures["missed"]) == (2, 1)
    assert [one["count"] for one in figures["calibration"]] == [1, 1, 1, 2]
    assert [one["right"] for one in figures["calibration"]] == [0.0, 1.0, 0.0, 0.5]
    assert figures["calibration"][-1]["presence"] == pytest.approx(0.995)


def test_absent_shapes_are_asked_for_in_place_of_present_ones(
    meshes: dict[str, trimesh.Trimesh], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One of two on the table, and the one that is not; what is found without being there has no error."""
    bench = PoseBench(meshes, 2, 5, true_object)
    table = make_table(meshes, 2, 5)
    present = {one.shape for one in table.recording.truth.objects}
    asked: list[str] = []

    def parsed(_: PoseBench, table: Table, config: object, names: list[str]) -> tuple[object, None]:
        assert config == ParseConfig(presence=0.5)
        asked[:] = names
        truth = table.recording.truth.objects
        true = {one.shape: table.camera_from_world @ one.world_from_object for one in truth}
        return scene_result(names, [true.get(name, np.eye(4)) for name in names], [2, 2]), None

    monkeypatch.setattr(PoseBench, "_parsed", parsed)
    reported = {one.shape: one for one in bench.presences(0, 1)}
    assert len(present & set(asked)) == 1
    assert len(set(asked) - present) == 1
    for name, one in reported.items():
        assert one.there == (name in present)
        assert one.right == one.there
