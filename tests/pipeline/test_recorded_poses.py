"""Poses that a recording brings, where they do not fit its frames."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from pipeline.cli import voxscene
from pipeline.errors import PipelineError
from pipeline.evaluation.trajectories import compared, reference_trajectory
from pipeline.synthesis.recording import SyntheticRecording
from recordings.options import ReadOptions
from recordings.writer import RecordingWriter


def write(film: SyntheticRecording, path: Path, poses: Sequence[np.ndarray]) -> Path:
    """The frames of a film, the first of them with these poses on /tf."""
    with RecordingWriter(path, film.intrinsics) as writer:
        for number, frame in enumerate(film):
            if number < len(poses):
                writer.write_camera_pose(frame.time_ns, poses[number])
            writer.write_depth(frame)
    return path


def learn(recording: Path, tmp_path: Path, *arguments: str) -> Result:
    """By the recording's own poses."""
    command = ["learn", str(recording), "--name", "mug", "--poses", "recorded", *arguments]
    return CliRunner().invoke(voxscene, [*command, "-o", str(tmp_path / "run")])


@pytest.mark.parametrize("count", [1, 6])
def test_a_camera_that_never_moved_teaches_no_shape(
    count: int, filmed_mug: SyntheticRecording, tmp_path: Path
) -> None:
    """A mounting on /tf, once or at every frame, is no path: the line says what to do."""
    path = write(filmed_mug, tmp_path / "rest.mcap", [np.eye(4)] * count)
    result = learn(path, tmp_path)
    assert result.exit_code == 1, result.output
    assert "the camera never moved" in result.stderr
    assert "without --poses recorded slam finds the camera" in result.stderr


def test_eval_counts_no_frame_without_a_pose_near_in_time(
    filmed_mug: SyntheticRecording,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One pose is none for the frames after it; a camera at rest is judged, with a warning."""
    monkeypatch.setattr(logging.getLogger("voxscene"), "propagate", True)
    times_ns = filmed_mug.trajectory.times_ns
    once = reference_trajectory(write(filmed_mug, tmp_path / "once.mcap", [np.eye(4)]), ReadOptions())
    with pytest.raises(PipelineError, match="fewer than two frames have a reference pose"):
        compared(times_ns, once)
    assert not caplog.messages
    rest = reference_trajectory(write(filmed_mug, tmp_path / "rest.mcap", [np.eye(4)] * 6), ReadOptions())
    assert len(compared(times_ns, rest)[0]) == 6
    assert "the camera never moved" in caplog.text
