"""`voxscene eval shapes` places the truth where the run's camera saw it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from pipeline.cli import voxscene
from pipeline.config import Settings
from pipeline.errors import PipelineError
from pipeline.evaluation.shapes import true_voxels
from pipeline.evaluation.truth import RecordedTruth, true_mesh
from pipeline.options import Common, RecordingSource
from pipeline.session import open_session
from recordings.types import CameraIntrinsics, Frame
from recordings.writer import RecordingWriter
from shapes.prior import ShapePrior
from slam.result import SlamResult


def perfect_shape(truth: RecordedTruth) -> ShapePrior:
    """What a perfect learner would know of the mug, every voxel of it seen."""
    reference_from_world = truth.camera_from_world(int(truth.trajectory.times_ns[0]))
    one = truth.object_of_shape("mug")
    mesh = true_mesh(one)
    size = np.ceil(mesh.extents / 0.005).astype(int) + 4
    grid = reference_from_world @ one.world_from_object
    grid[:3, 3] += grid[:3, :3] @ (mesh.bounds[0] - 0.01)
    blank = ShapePrior(
        phi=np.full(size, 0.5, np.float32),
        pitch_m=0.005,
        reference_from_grid=grid,
        seen_free=np.zeros(size, bool),
        seen_occupied=np.zeros(size, bool),
        enclosed=np.zeros(size, bool),
    )
    occupied = true_voxels(blank, mesh, reference_from_world @ one.world_from_object)
    return ShapePrior(
        phi=np.where(occupied, 0.9, 0.1).astype(np.float32),
        pitch_m=0.005,
        reference_from_grid=grid,
        seen_free=~occupied,
        seen_occupied=occupied,
        enclosed=np.zeros(size, bool),
    )


def test_a_perfect_shape_agrees_wholly(mug_file: Path, true_trajectory: SlamResult, tmp_path: Path) -> None:
    """Through the file and the command line."""
    shape = perfect_shape(RecordedTruth(mug_file))
    common = Common(as_json=True, quiet=True, settings=Settings({}))
    with open_session(common, RecordingSource(path=mug_file, said={}), tmp_path / "run") as session:
        session.stage("slam", SlamResult.load, lambda: true_trajectory, {})
        session.stage("learn/mug", ShapePrior.load, lambda: shape, {})
    arguments = ["eval", "shapes", str(tmp_path / "run"), "--truth", str(mug_file)]
    result = CliRunner().invoke(voxscene, [*arguments, "--json"])

    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout) == {"mug": {"solid": 1, "shell": 1, "observed": 1, "pitch_m": 0.005}}
    table = CliRunner().invoke(voxscene, arguments).stdout
    assert all(f"{column}, " in table for column in ("solid", "shell", "observed"))


def test_one_bad_frame_does_not_move_the_truth(mug_file: Path, true_trajectory: SlamResult) -> None:
    """Nor does a lost one."""
    truth = RecordedTruth(mug_file)
    one = truth.object_of_shape("mug")
    exact = truth.camera_from_world(int(true_trajectory.times_ns[0])) @ one.world_from_object
    mean, lost = true_trajectory.mean.copy(), true_trajectory.lost.copy()
    mean[3, :3, 3] += 1.0
    lost[4] = True
    mean[4] = np.eye(4)
    shaken = replace(true_trajectory, mean=mean, lost=lost)

    np.testing.assert_allclose(
        truth.reference_from_object(one, true_trajectory.tracked_path), exact, atol=1e-9
    )
    np.testing.assert_allclose(truth.reference_from_object(one, shaken.tracked_path), exact, atol=1e-9)


def test_what_has_no_truth_is_named(mug_file: Path, tmp_path: Path) -> None:
    """No objects in the file, no pose at the time, no run."""
    camera = CameraIntrinsics(width=8, height=6, fx=8.0, fy=8.0, cx=3.5, cy=2.5)
    with RecordingWriter(tmp_path / "plain.mcap", camera) as writer:
        writer.write_depth(Frame(time_ns=1, depth_m=np.ones((6, 8), np.float32)))
    with pytest.raises(PipelineError, match="holds no true"):
        RecordedTruth(tmp_path / "plain.mcap")
    with pytest.raises(PipelineError, match="no true camera pose at"):
        RecordedTruth(mug_file).camera_from_world(5)
    result = CliRunner().invoke(voxscene, ["eval", "shapes", str(tmp_path), "--truth", str(mug_file)])
    assert (result.exit_code, "holds no learned shape" in result.stderr) == (1, True)


def test_the_only_object_is_meant_whatever_the_shape_is_called(mug_file: Path) -> None:
    """As users name shapes as they like."""
    assert RecordedTruth(mug_file).object_of_shape("my cup").name == "mug"
