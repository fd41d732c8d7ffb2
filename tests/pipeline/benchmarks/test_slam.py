"""The table of `bench slam`: what is counted as lost, what is skipped, and that cases are what they say."""

from __future__ import annotations

from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest
from scipy import stats

from pipeline.benchmarks import slam as bench
from pipeline.benchmarks import slam_coverage
from pipeline.benchmarks.slam_cases import Case, Row, real_rows, short_walk, synthetic_rows
from slam.config import SlamConfig


def _short(case: Case, frames: int) -> Case:
    return Case(
        frames=case.frames[:frames],
        intrinsics=case.intrinsics,
        poses=case.poses[:frames],
        object_m=case.object_m,
    )


@pytest.mark.slow  # compiles the whole tracker, which tests of slam do as well
def test_a_row_reports_ours_and_counts_lost_peers(monkeypatch: pytest.MonkeyPatch):
    """Ours follows an orbit to centimetres; a peer that raises is lost, one that knows the truth is exact."""
    orbit = synthetic_rows()[0]
    first = partial(lambda case, number: _short(case(number), 4), orbit.case)
    truth = orbit.case(0).poses[:4]

    settings = {"exact": Mock(return_value=truth), "broken": Mock(side_effect=RuntimeError("no overlap"))}
    monkeypatch.setattr(bench, "settings_of", lambda name: {name: settings[name]})
    row = Row(name="orbit", case=first, real=True, configs={"voxscene": SlamConfig(particles=16)})
    told = Mock()

    (line,) = bench.slam_rows([row], ["exact", "broken"], 3, 0, told)

    assert line["runs"] == 1
    told.assert_called_once_with(1, 1)
    assert line["trackers"]["voxscene"]["error"]["most"] < 0.02
    assert line["trackers"]["exact"]["error"]["most"] == pytest.approx(0.0, abs=1e-9)
    assert line["trackers"]["broken"]["lost_runs"] == 1
    assert "error" not in line["trackers"]["broken"]


def test_missing_data_is_skipped_with_its_reason(tmp_path):
    """Rows whose folder is missing name it, and the others go on."""
    rows = real_rows(tmp_path / "nowhere")

    measured = list(bench.slam_rows(rows, [], 1, 0, Mock()))

    assert len(measured) == 5
    assert all("nowhere" in row["skipped"] for row in measured)


@pytest.mark.parametrize("name", ["bare room, 12 degrees a frame", "5 views round an object"])
def test_cases_are_seeded_and_start_at_the_identity(name: str):
    """The same number gives the same frames; another gives others; the first camera is the reference."""
    row = next(row for row in synthetic_rows() if row.name == name)

    case, again, other = row.case(3), row.case(3), row.case(4)

    np.testing.assert_array_equal(case.frames[1].depth_m, again.frames[1].depth_m)
    assert (case.frames[1].depth_m != other.frames[1].depth_m).any()
    np.testing.assert_allclose(case.poses[0], np.eye(4), atol=1e-12)
    assert (case.object_m is not None) == (row.judged_by == "object")


def test_coverage_holds_for_the_stated_spread_alone(monkeypatch: pytest.MonkeyPatch):
    """Truths on evenly spread levels lie inside at every level; those of half the spread do not."""
    runs = 400
    exact = (np.arange(runs) + 0.5) / runs
    told = Mock()
    monkeypatch.setattr(slam_coverage, "_level", lambda _, number: (exact[number - 10_000], 0.0))

    row = slam_coverage.coverage_row(runs, 1, told)
    narrow = slam_coverage.summary(stats.chi2.cdf(4 * stats.chi2.ppf(exact, 6), 6))

    assert told.call_count == row["runs"] == runs
    assert row["median_level"] == pytest.approx(0.5, abs=0.01)
    assert all(figures["holds"] for figures in row["coverage"].values())
    assert not any(figures["holds"] for figures in narrow["coverage"].values())
    assert narrow["median_level"] > 0.9


def test_short_walks_are_seeded_and_differ():
    """The same number gives the same depth; the first camera is the reference."""
    first, again, other = (short_walk(number) for number in (3, 3, 4))

    np.testing.assert_array_equal(first.frames[2].depth_m, again.frames[2].depth_m)
    assert not np.array_equal(first.frames[2].depth_m, other.frames[2].depth_m)
    np.testing.assert_allclose(first.poses[0], np.eye(4), atol=1e-12)


def test_a_mode_holds_the_truth_along_the_whole_path() -> None:
    """Not where the middle is turned by a quarter and the end is right: circles alias like that."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    turned = poses.copy()
    turned[1, :2, :2] = [[0, -1], [1, 0]]
    case = Case(frames=[], intrinsics=Mock(), poses=poses)

    held, missed = (
        bench._holds_truth(Mock(trajectories=np.stack(paths)), case)
        for paths in ([turned, poses], [turned, turned])
    )

    assert held
    assert not missed
