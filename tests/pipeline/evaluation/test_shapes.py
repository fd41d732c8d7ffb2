"""Agreement of shapes is one for the truth and falls with what is wrong."""

import numpy as np
import pytest
import trimesh

from pipeline.evaluation.shapes import intersection_over_union, shape_agreement, true_voxels
from shapes.prior import ShapePrior

PITCH_M = 0.01


def blank(pose: np.ndarray) -> ShapePrior:
    """A grid of 12 x 10 x 8 voxels in which nothing was seen."""
    nothing = np.zeros((12, 10, 8), bool)
    return ShapePrior(
        phi=np.full(nothing.shape, 0.5, np.float32),
        pitch_m=PITCH_M,
        reference_from_grid=pose,
        seen_free=nothing,
        seen_occupied=nothing,
        enclosed=nothing,
    )


def learned(occupied: np.ndarray, seen: np.ndarray, pose: np.ndarray) -> ShapePrior:
    """A shape that knows the voxels `seen`, with the other occupied ones enclosed."""
    return ShapePrior(
        phi=np.where(occupied, 0.9, 0.1).astype(np.float32),
        pitch_m=PITCH_M,
        reference_from_grid=pose,
        seen_free=seen & ~occupied,
        seen_occupied=seen & occupied,
        enclosed=occupied & ~seen,
    )


@pytest.fixture
def pose() -> np.ndarray:
    """Somewhere in the reference frame."""
    turn = trimesh.transformations.rotation_matrix(0.8, [1, 2, 3])
    turn[:3, 3] = [0.3, -0.2, 1.0]
    return turn


@pytest.fixture
def box() -> trimesh.Trimesh:
    """A box that fills voxels 2..9, 3..6, 0..4 of the grid."""
    return trimesh.creation.box(bounds=np.array([[2, 3, 0], [10, 7, 5]]) * PITCH_M)


def test_true_voxels_are_those_with_their_centre_inside(pose: np.ndarray, box: trimesh.Trimesh) -> None:
    """Exactly the block of the box, whatever the pose."""
    truth = true_voxels(blank(pose), box, pose)

    expected = np.zeros_like(truth)
    expected[2:10, 3:7, :5] = True
    np.testing.assert_array_equal(truth, expected)


def test_the_truth_agrees_with_itself(pose: np.ndarray, box: trimesh.Trimesh) -> None:
    """By all three measures, though its inside was not seen."""
    truth = true_voxels(blank(pose), box, pose)
    seen = np.ones_like(truth)
    seen[3:9, 4:6, 1:4] = False
    agreement = shape_agreement(learned(truth, seen, pose), box, pose)

    assert (agreement.solid, agreement.shell, agreement.observed) == (1, 1, 1)


def test_a_missing_layer_lowers_the_solid_measure_and_an_unseen_one_not_the_observed(
    pose: np.ndarray, box: trimesh.Trimesh
) -> None:
    """One layer of eight is an eighth."""
    truth = true_voxels(blank(pose), box, pose)
    partial = truth.copy()
    partial[2] = False
    everywhere = np.ones_like(truth)
    unseen = everywhere.copy()
    unseen[2] = False

    assert shape_agreement(learned(partial, everywhere, pose), box, pose).observed == pytest.approx(7 / 8)
    agreement = shape_agreement(learned(partial, unseen, pose), box, pose)
    assert agreement.observed == 1
    assert agreement.solid == pytest.approx(7 / 8)


def test_intersection_over_union_of_nothing_is_one() -> None:
    """And of disjoint sets nothing."""
    nothing, everything = np.zeros(3, bool), np.ones(3, bool)

    assert intersection_over_union(nothing, nothing) == 1
    assert intersection_over_union(nothing, everything) == 0
