"""Scores of probabilities against worked examples."""

import numpy as np
import pytest

from pipeline.evaluation.calibration import calibration
from tests.statistical import assert_mean


def test_scores_of_four_voxels() -> None:
    """By hand: two bins, one well and one badly calibrated."""
    scores = calibration(np.array([0.9, 0.9, 0.2, 0.2]), np.array([True, True, True, False]))
    assert scores.brier == pytest.approx((0.01 + 0.01 + 0.64 + 0.04) / 4)
    assert scores.log_loss == pytest.approx(-(2 * np.log(0.9) + np.log(0.2) + np.log(0.8)) / 4)
    assert scores.ece == pytest.approx((2 * 0.1 + 2 * 0.3) / 4)
    assert scores.count == 4


def test_certainty_is_clipped() -> None:
    """A sure error costs log(1000), not infinity."""
    assert calibration(np.zeros(1), np.ones(1, bool)).log_loss == pytest.approx(np.log(1000))


def test_probabilities_that_are_right_score_no_calibration_error(seed: int) -> None:
    """Up to the noise of 15 bins, whose expectation is known to be near sqrt(2 p q / (pi n))."""
    rng = np.random.default_rng(seed)
    errors = []
    for _ in range(40):
        phi = rng.uniform(size=20_000)
        errors.append(calibration(phi, rng.random(20_000) < phi).ece)
    expected = np.mean([np.sqrt(2 * p * (1 - p) / (np.pi * 20_000 / 15)) for p in (np.arange(15) + 0.5) / 15])
    assert_mean(np.asarray(errors), expected, detectable=0.003)
