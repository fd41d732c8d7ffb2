"""What residuals teach of the sensor, from moments that are known."""

from __future__ import annotations

import numpy as np
import pytest

from recordings.types import DepthNoise
from shapes.depth_noise import standard_deviation
from slam.likelihood.noise_calibration import BIN_EDGES_M, EXPONENT_RANGE, NoiseCalibration

PIXELS = 1e5
"""In each bin of depth and frame: the initial sigma, which counts as 200, is forgotten."""


def test_a_sensor_twice_as_noisy_is_learnt() -> None:
    """Squared residuals are told over the present variance, whatever that is by then."""
    true = DepthNoise(
        sigma_base_m=2 * DepthNoise().sigma_base_m, sigma_growth_per_m=2 * DepthNoise().sigma_growth_per_m
    )
    centres = 0.5 * (BIN_EDGES_M[1:] + BIN_EDGES_M[:-1])
    variance = standard_deviation(true, centres) ** 2
    found = NoiseCalibration.initial(None, 0.1)
    for _ in range(10):
        present = standard_deviation(found.noise, centres) ** 2
        count = np.full(len(centres), PIXELS)
        found = found.after(count * variance / present, count, np.eye(6), np.eye(6))

    np.testing.assert_allclose(standard_deviation(found.noise, centres), np.sqrt(variance), rtol=1e-3)


@pytest.mark.parametrize("inflation", [0.5, 4.0, 1e4])
def test_the_exponent_is_the_curvature_over_the_variance_of_the_score(inflation: float, seed: int) -> None:
    """V = c H gives 1 / c, within what pixels can count; frames are averaged."""
    factor = np.random.default_rng(seed).normal(size=(6, 6))
    curvature = factor @ factor.T + np.eye(6)
    none = np.zeros(len(BIN_EDGES_M) - 1)
    found = NoiseCalibration.initial(DepthNoise(), None)
    for share in (0.5, 1.5):
        found = found.after(none, none, curvature, share * inflation * curvature)

    assert found.exponent == pytest.approx(np.clip(1 / inflation, *EXPONENT_RANGE), rel=1e-6)
    assert found.noise == DepthNoise()
