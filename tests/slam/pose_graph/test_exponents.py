"""By how much what images say of poses is repetition, from overlaps made by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from slam.pose_graph.linearisation import Linearised, exponents_of
from slam.pose_graph.sparse_gaussian import PoseGraph


@pytest.mark.parametrize("repetition", [0.5, 1.0, 3.0])
def test_pixels_count_once_and_as_many_as_are_independent(repetition: float, seed: int) -> None:
    """Of two equal surfaces each tells half; where scores vary more than by the curvature, that much less."""
    factors = np.random.default_rng(seed).normal(size=(4, 6, 6))
    curvature = 1e4 * (factors @ factors.transpose(0, 2, 1) + np.eye(6))
    pairs = np.array([[0, 1], [0, 2], [1, 0], [2, 0]])
    overlaps = Linearised(
        graph=cast(PoseGraph, SimpleNamespace(pairs=pairs, keyframes=4)),
        curvature=curvature,
        score_variance=repetition * curvature,
        inliers=np.array([100.0, 100.0, 50.0, 300.0]),
        meeting=np.full(4, 300.0),
    )

    expected = np.array([0.5, 1.0, 1.0, 1.0]) / max(repetition, 1.0)
    np.testing.assert_allclose(exponents_of(overlaps), expected, rtol=1e-2)
