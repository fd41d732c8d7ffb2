"""`eval shapes --held-back`: how far a learned surface lies from depth that learning did not get."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.evaluation.held_back import held_back_errors, held_back_times
from recordings.types import NO_RETURN, CameraIntrinsics, Frame
from shapes.learning.config import LearnConfig
from shapes.prior import ShapePrior
from slam.result import SlamResult

INTRINSICS = CameraIntrinsics(width=64, height=48, fx=80.0, fy=80.0, cx=31.5, cy=23.5)
FACE_M = 0.5


@pytest.fixture
def cube() -> ShapePrior:
    """Ten voxels a side, its near face at `FACE_M` before the first camera."""
    occupied = np.zeros((14, 14, 14), bool)
    occupied[2:12, 2:12, 2:12] = True
    pose = np.eye(4)
    pose[:3, 3] = [-0.035, -0.035, FACE_M - 0.01]
    return ShapePrior(
        phi=np.where(occupied, 0.95, 0.05).astype(np.float32),
        pitch_m=0.005,
        reference_from_grid=pose,
        seen_free=~occupied,
        seen_occupied=occupied,
        enclosed=np.zeros_like(occupied),
    )


def test_distances_are_those_along_the_rays(cube: ShapePrior, true_trajectory: SlamResult) -> None:
    """A wall 3 mm behind the face; what has no return does not count."""
    depth = np.full((48, 64), FACE_M + 0.003, np.float32)
    depth[:, :32] = NO_RETURN
    frame = Frame(time_ns=int(true_trajectory.times_ns[0]), depth_m=depth, rgb=None)
    found = held_back_errors(cube, [frame], INTRINSICS, true_trajectory.tracked_path)
    assert found.frames == 1
    assert found.median_m == pytest.approx(0.003, abs=2e-4)
    assert 16 <= found.pixels <= 64


def test_a_view_without_the_shape_does_not_count(cube: ShapePrior, true_trajectory: SlamResult) -> None:
    """Nothing is known where no ray with a return meets the surface."""
    empty = np.full((48, 64), NO_RETURN, np.float32)
    frame = Frame(time_ns=int(true_trajectory.times_ns[0]), depth_m=empty, rgb=None)
    assert held_back_errors(cube, [frame], INTRINSICS, true_trajectory.tracked_path).median_m is None


def test_only_tracked_frames_that_were_not_used_are_held_back(true_trajectory: SlamResult) -> None:
    """Of six frames one is lost and three are learned from."""
    lost = np.array([False, True, False, False, False, False])
    times = held_back_times(replace(true_trajectory, lost=lost).tracked_path, LearnConfig(views=3))
    np.testing.assert_array_equal(times, true_trajectory.times_ns[[2, 4]])
