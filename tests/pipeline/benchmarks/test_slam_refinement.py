"""Rows of the joint refinement: drift that is undone, and a distortion field learned elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import jax
import numpy as np
import pytest

from pipeline.benchmarks import slam_refinement
from pipeline.benchmarks.slam_cases import Case, kitchen, short_walk
from pipeline.benchmarks.slam_refinement import drift_row, frame_gaps, halves_row
from pipeline.synthesis.sensor import DepthSensor, _distorted


def test_frames_at_their_true_poses_differ_by_noise_alone() -> None:
    """A centimetre, that of structured light three metres away; moved by 3 cm, by more."""
    case = short_walk(3)
    moved = case.poses.copy()
    moved[1::2, :3, 3] += 0.03

    true, wrong = (frame_gaps(case.frames, poses, case.intrinsics) for poses in (case.poses, moved))

    assert len(true) > 1000
    assert np.median(true) < 0.015
    assert np.median(wrong) > 1.5 * np.median(true)


def test_drift_that_is_put_in_is_told_and_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    """By an optimiser that always finds the same, none is left; by one that moves nothing, all of it."""
    count = 5
    poses = np.tile(np.array([1.0, 0, 0, 0, 0, 0, 0], np.float32), (1, count, 1))
    maps = Mock(poses=poses)
    monkeypatch.setattr(slam_refinement, "_keyframes", lambda _: (None, maps))
    monkeypatch.setattr(slam_refinement, "replace", lambda _, **new: Mock(**new))
    told = Mock()

    def kept(_: object, __: object, moved: Mock, *___: object, **____: object) -> Mock:
        return Mock(poses=moved.poses)

    monkeypatch.setattr(slam_refinement, "refine_keyframes", lambda *_, **__: Mock(poses=poses))
    undone = drift_row(Mock(), 0, told)
    monkeypatch.setattr(slam_refinement, "refine_keyframes", kept)
    left = drift_row(Mock(), 0, told)

    assert told.call_args.args == (3, 3)
    assert undone["keyframes"] == count
    assert [run["left_m"] for run in undone["drift"]] == [0.0, 0.0]
    at_random, straight = left["drift"]
    assert straight["put_in_m"] == pytest.approx(0.03 * (count - 1))
    assert 0 < at_random["put_in_m"] < straight["put_in_m"]
    assert all(run["left_m"] == pytest.approx(run["put_in_m"], abs=1e-6) for run in left["drift"])


def test_without_the_recording_both_rows_are_skipped(tmp_path: Path) -> None:
    """They name the folder that is missing."""
    case = kitchen(tmp_path / "nowhere", 5)
    assert "nowhere" in drift_row(case, 0, Mock())["skipped"]
    assert "nowhere" in halves_row(case, Mock())["skipped"]


@pytest.mark.slow  # tracks five short sequences
def test_a_field_learned_elsewhere_brings_frames_closer() -> None:
    """Two walks, seen by a sensor with one distortion field: less disagreement of each by the other's."""
    field = DepthSensor(distortion_per_m=3e-3).drawn_distortion(jax.random.key(5))
    assert field is not None
    case = short_walk(11)
    frames = [replace(one, depth_m=_distorted(one.depth_m, field)) for one in [*case.frames] * 2]
    twice = Case(frames=frames, intrinsics=case.intrinsics, poses=np.tile(case.poses, (2, 1, 1)))

    row = halves_row(lambda _: twice, Mock())

    assert row["frames"] == 8
    assert all(half["rms_corrected_m"] < half["rms_m"] for half in row["halves"])
