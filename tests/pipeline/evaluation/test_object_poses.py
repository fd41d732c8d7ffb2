"""Pose errors against closed forms and brute force."""

import numpy as np
import pytest
import trimesh

from pipeline.evaluation.object_poses import (
    MISSING_M,
    accuracy,
    add_s_m,
    area_under_accuracy,
    best_matches,
    model_points,
)


def test_add_s_is_the_mean_distance_to_the_nearest_point(seed: int) -> None:
    """Against all pairs."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(50, 3))
    truth, estimate = (trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)) for _ in range(2))
    estimate[:3, 3] = rng.normal(scale=0.1, size=3)
    ours, theirs = trimesh.transform_points(points, truth), trimesh.transform_points(points, estimate)
    brute = np.linalg.norm(ours[:, None] - theirs[None], axis=-1).min(axis=1).mean()

    assert add_s_m(points, truth, estimate) == pytest.approx(brute)


def test_a_true_estimate_has_no_error_and_a_missing_one_a_metre() -> None:
    """Symmetries included: a turned cylinder is where it was."""
    can = trimesh.creation.cylinder(0.03, 0.2, sections=512)
    points = model_points(can)
    turn = trimesh.transformations.rotation_matrix(1.0, [0, 0, 1])

    assert add_s_m(points, np.eye(4), np.eye(4)) == 0
    assert add_s_m(points, np.eye(4), None) == MISSING_M
    assert add_s_m(points, np.eye(4), turn) < 0.001
    side = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    assert add_s_m(points, np.eye(4), side) > 0.02


def test_model_points_cover_the_surface_alike_each_time() -> None:
    """By area: two thirds of a flat box's points lie on its large faces."""
    box = trimesh.creation.box((0.1, 0.1, 0.05))
    points = model_points(box)

    np.testing.assert_array_equal(points, model_points(box))
    assert abs((np.abs(points[:, 2]) > 0.0249).mean() - 0.5) < 0.05


def test_accuracy_and_its_area() -> None:
    """The area is the limit of mean accuracy over many thresholds."""
    errors = np.array([0.0, 0.004, 0.02, 0.05, 0.2, MISSING_M])
    thresholds = (np.arange(100_000) + 0.5) / 100_000 * 0.1
    curve = (errors[:, None] <= thresholds).mean()

    assert accuracy(errors, 0.02) == 1 / 3  # strictly under
    assert accuracy(errors, 0.021) == 0.5
    assert area_under_accuracy(errors) == pytest.approx(curve, abs=1e-5)


def test_instances_of_one_shape_are_matched_once_each() -> None:
    """So that the sum of errors is least."""
    errors = np.array([[0.1, 0.2], [0.11, 0.9]])

    assert best_matches(errors) == [(0, 1), (1, 0)]
