"""The table of `bench poses`: who is judged on what, and that peers find an object alone."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.benchmarks.poses import Judged, PoseBench, _figures
from pipeline.evaluation.object_poses import add_s_m, model_points
from pipeline.peers.registration import Model, settings
from pipeline.synthesis.objects import built_in_object
from tests.scene.results import scene_result

SHAPES = ("bracket", "mug", "bottle")


@pytest.fixture(scope="module")
def bench() -> PoseBench:
    """Three objects, one of them stacked."""
    return PoseBench({name: built_in_object(name) for name in SHAPES}, 3, 0)


def test_tables_repeat_and_differ(bench: PoseBench) -> None:
    """The same number gives the same depth, and a third of the objects are stacked."""
    first, again, other = bench.table(1), bench.table(1), bench.table(2)
    np.testing.assert_array_equal(first.frame.depth_m, again.frame.depth_m)
    assert (first.frame.depth_m != other.frame.depth_m).any()
    assert sum(one.parent != "table" for one in first.recording.truth.objects) >= 1


def test_the_truth_is_judged_perfect_and_hidden_objects_are_not(bench: PoseBench) -> None:
    """Poses and parents from the truth itself."""
    table = bench.table(1)
    truth = table.recording.truth.objects
    names = [*(one.name for one in truth), "table"]
    scene = scene_result(
        [one.shape for one in truth],
        [table.camera_from_world @ one.world_from_object for one in truth],
        [names.index(str(one.parent)) for one in truth],
    )
    judged = bench._judged(table, scene)
    seen = [one for one in truth if (one.visible_fraction or 0) >= 0.25]
    assert [one.error_m for one in judged] == pytest.approx([0] * len(seen), abs=1e-9)
    assert all(one.parent_right in (True, None) for one in judged)
    nothing = bench._judged(table, replace(scene, presence=np.zeros(3)))
    assert {one.error_m for one in nothing} == {1.0}


def test_true_masks_hold_the_object_alone(bench: PoseBench) -> None:
    """Masked points lie on the object; unmasked ones hold them all."""
    table = bench.table(1)
    everything = bench._observed(table, masked=False)[0]
    for one, points in zip(table.recording.truth.objects, bench._observed(table, masked=True), strict=True):
        inside = np.linalg.inv(table.camera_from_world @ one.world_from_object)
        own = points @ inside[:3, :3].T + inside[:3, 3]
        low, high = built_in_object(one.shape).bounds
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


def test_rows() -> None:
    """Stacked and not, parents of flush rests alone."""
    judged = [
        Judged(error_m=0.002, stacked=False, parent_right=True),
        Judged(error_m=0.015, stacked=True, parent_right=False),
        Judged(error_m=1.0, stacked=True),
    ]
    figures = _figures(judged, [1.0, 3.0, 2.0])
    assert figures["rows"]["all"]["accuracy"]["0.01"] == pytest.approx(1 / 3)
    assert figures["rows"]["stacked"]["objects"] == 2
    assert figures["parents_right_flush"] == 0.5
    assert figures["seconds_median"] == 2.0
