"""The film of an hour, and what is told of tracking it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from pipeline.benchmarks import slam_hour
from pipeline.benchmarks.flats import ROOM_M, flat_film
from pipeline.synthesis.recording import SyntheticRecording


@pytest.fixture(scope="module")
def film() -> SyntheticRecording:
    """A short hour."""
    return flat_film(6000, 3)


def test_a_flat_is_walked_through_and_left_where_it_was_entered(film: SyntheticRecording):
    """Steps of a hand's breadth at most, a walker's clearance, every room, and the first one again."""
    poses = film.trajectory.reference_from_camera
    rooms = {tuple(room) for room in np.round(poses[:, :2, 3] / ROOM_M).astype(int).tolist()}

    assert len(film) == 6000
    assert len(rooms) == 20
    assert np.linalg.norm(poses[-1, :2, 3] - poses[0, :2, 3]) < 1.5
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() < 0.1
    assert film.clearance_m(poses[:, :3, 3]).min() > 0.25


def test_the_row_tells_what_frames_cost(film: SyntheticRecording, monkeypatch: pytest.MonkeyPatch):
    """Of a tracker that is exact, and takes twice as long over the second half; the film's own time apart."""
    clock, told = [0.0], Mock()
    monkeypatch.setattr(slam_hour, "processor_clock", lambda: clock[0])

    def exact(_: Any, frames: Iterable[Any], __: Any, ___: Any, on_frame: Callable, **____: Any) -> Any:
        for index, _frame in enumerate(frames):
            clock[0] += 0.02 if index < 3000 else 0.04
            on_frame(Mock(keyframes=7))
        poses = film.trajectory.reference_from_camera
        mean = np.linalg.inv(poses[0]) @ poses
        mean[-1, 0, 3] += 0.03
        spread = np.tile(1e-4 * np.eye(6), (6000, 1, 1))
        return Mock(mean=mean, covariance=spread, lost=np.zeros(6000, bool))

    unseen = Mock(trajectory=film.trajectory, frame=Mock(return_value=None))
    monkeypatch.setattr(slam_hour, "flat_film", lambda *_: unseen)
    monkeypatch.setattr(slam_hour, "track", exact)

    row = slam_hour.hour_row(6000, 3, told)

    assert told.call_args.args == (6000, 6000)
    assert row["keyframes"] == 7
    assert row["last_to_first_tenth"] == pytest.approx(0.5, rel=0.01)
    assert row["kernels_after_start"] == 0
    assert row["end_m"] == pytest.approx(0.03)
    assert row["told_end_m"] == pytest.approx(np.sqrt(3e-4))
    assert row["median_m"] == pytest.approx(0.0, abs=1e-9)
