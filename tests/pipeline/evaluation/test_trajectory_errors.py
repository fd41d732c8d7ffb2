"""Trajectory errors against hand-made cases."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from pipeline.evaluation.trajectory_errors import (
    coverage,
    largest_squared_distance,
    level_of,
    matched,
    squared_distances,
    trajectory_errors,
)
from recordings.types import Trajectory
from tests.statistical import assert_coverage

DEGREES = 7.0


def _poses(rng: np.random.Generator, count: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3))
    return poses


def test_another_reference_frame_is_no_error(seed):
    """A rigidly moved trajectory has no error of any kind."""
    rng = np.random.default_rng(seed)
    truth, moved = _poses(rng, 20), _poses(rng, 1)[0]

    errors = trajectory_errors(moved @ truth, truth)

    for error in (errors.ate_m, errors.ate_first_pose_m, errors.rpe_translation_m, errors.rpe_rotation_rad):
        assert error == pytest.approx(0, abs=1e-7)


def test_first_pose_alignment_sees_what_the_best_alignment_hides(seed):
    """A first pose turned by 0.1 rad moves every other frame, but hardly the aligned error."""
    truth = _poses(np.random.default_rng(seed), 200)
    wrong = truth.copy()
    wrong[0, :3, :3] = truth[0, :3, :3] @ Rotation.from_rotvec([0, 0, 0.1]).as_matrix()

    errors = trajectory_errors(wrong, truth)

    assert errors.ate_m == pytest.approx(0, abs=1e-7)
    assert errors.ate_first_pose_m > 0.05


def test_a_constant_drift_shows_in_relative_errors():
    """A step that is 1 cm too long is a relative error of 1 cm."""
    truth = np.tile(np.eye(4), (10, 1, 1))
    drifted = truth.copy()
    drifted[:, 0, 3] = 0.01 * np.arange(10)

    errors = trajectory_errors(drifted, truth)

    assert errors.rpe_translation_m == pytest.approx(0.01, rel=1e-6)
    assert errors.ate_first_pose_m == pytest.approx(0.01 * np.sqrt((np.arange(10) ** 2).mean()), rel=1e-6)


def test_regions_of_a_known_student_cover_at_their_level(seed):
    """Truths drawn from a multivariate Student-t lie in its regions at the nominal rates."""
    rng = np.random.default_rng(seed)
    factor = 0.01 * rng.normal(size=(6, 6))
    mean = _poses(rng, 2000)
    scale = np.sqrt(rng.chisquare(DEGREES, 2000) / DEGREES)
    tangent = rng.normal(size=(2000, 6)) @ factor.T / scale[:, None]
    moved = np.tile(np.eye(4), (2000, 1, 1))
    moved[:, :3, 3] = tangent[:, :3]
    moved[:, :3, :3] = Rotation.from_rotvec(tangent[:, 3:]).as_matrix()
    covariance = factor @ factor.T * DEGREES / (DEGREES - 2)

    squared = squared_distances(mean, np.tile(covariance, (2000, 1, 1)), mean @ moved)

    for level, share in coverage(squared, DEGREES).items():
        assert_coverage(round(share * 2000), 2000, level)
    levels = [level_of(one, DEGREES) for one in squared]
    assert stats.kstest(levels, "uniform").pvalue > 1e-6


@pytest.mark.parametrize("level", [0.5, 0.95])
def test_many_degrees_of_freedom_are_a_gaussian(level: float):
    """The region's edge is that of chi-square, and lies on its own level."""
    edge = largest_squared_distance(level, 1e6)

    assert edge == pytest.approx(stats.chi2.ppf(level, 6), rel=1e-4)
    assert level_of(edge, 1e6) == pytest.approx(level, rel=1e-9)


def test_frames_are_matched_to_the_nearest_stamp_within_tolerance():
    """An unsorted reference is searched by time; frames without a near pose are left out."""
    reference = Trajectory(
        times_ns=np.asarray([40, 0, 100], np.int64) * 10**6,
        reference_from_camera=np.tile(np.eye(4), (3, 1, 1)),
    )

    frames, poses = matched(np.asarray([1, 45, 70, 99], np.int64) * 10**6, reference)

    assert frames.tolist() == [0, 1, 3]
    assert poses.tolist() == [1, 0, 2]
