"""A sensor's noise is recovered from images of rooms with things in them, without truth."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from numpy.typing import NDArray

from pipeline.synthesis.sensor_errors import correlated_normals
from recordings.types import NO_RETURN, CameraIntrinsics, DepthNoise
from shapes.calibration.noise_estimate import FEW_WINDOWS, NoiseEstimate, estimate_noise
from shapes.calibration.residual_correlation import LAGS, residual_covariances
from shapes.calibration.smooth_windows import WindowResiduals, quadratic_basis
from shapes.depth_noise import standard_deviation

CAMERA = CameraIntrinsics(width=400, height=300, fx=448.0, fy=448.0, cx=199.5, cy=149.5)
"""Windows of 32 pixels, 108 an image."""
DEPTHS_M = np.array([0.9, 1.2, 1.6, 2.1, 2.6])
IMAGES = 4


def seen(
    rng: np.random.Generator, noise: DepthNoise, correlation: float = 0.0, bumpy: float = 0.0
) -> NDArray[np.float32]:
    """An image of four leaning planes with a cylinder before them, as a sensor of that noise measures it.

    Args:
        rng: of the planes and the noise.
        noise: of the sensor.
        correlation: of residuals of neighbouring pixels, which falls with every pixel alike.
        bumpy: share of the image's rows that show gravel.
    """
    rows, columns = np.mgrid[:300, :400].astype(float)
    inverse = np.zeros((300, 400))
    for part in range(4):
        own = columns // 100 == part
        slope_x, slope_y = rng.uniform(-2e-4, 2e-4, 2)
        plane = 1 / rng.uniform(0.9, 2.6) + slope_x * (columns - 200) + slope_y * (rows - 150)
        inverse = np.where(own, np.maximum(plane, 0.3), inverse)
    across = (columns - 260) / 45
    bulge = np.where(np.abs(across) < 1, 1 / (0.85 - 0.05 * np.sqrt(np.maximum(1 - across**2, 0))), 0)
    depth_m = 1 / np.maximum(inverse, bulge)
    gravel = rows < 300 * bumpy
    depth_m += gravel * rng.uniform(-0.05, 0.05, depth_m.shape).cumsum(axis=1) * 0.3
    key = jax.random.key(int(rng.integers(2**31)))
    normals = correlated_normals(key, depth_m.shape, (correlation,) if correlation else ())
    depth_m += standard_deviation(noise, depth_m) * normals
    outlier = rng.random(depth_m.shape) < noise.outlier_probability
    depth_m = np.where(outlier, rng.uniform(0, noise.max_range_m, depth_m.shape), depth_m)
    none = rng.random(depth_m.shape) < noise.none_hit_probability
    return np.where(none | (depth_m < 0.1), NO_RETURN, depth_m).astype(np.float32)


def estimated(rng: np.random.Generator, noise: DepthNoise, **how: float) -> NoiseEstimate:
    """From some images."""
    images = [seen(rng, noise, **how) for _ in range(IMAGES)]
    return estimate_noise(WindowResiduals.together([WindowResiduals.of(one, CAMERA) for one in images]))


NOISES = {
    "the usual sensor": DepthNoise(),
    "a worse one": DepthNoise(
        sigma_base_m=0.003, sigma_growth_per_m=0.006, outlier_probability=0.03, none_hit_probability=0.12
    ),
    "one as good near as far": DepthNoise(sigma_base_m=0.002, sigma_growth_per_m=1e-5),
}


@pytest.mark.parametrize("name", NOISES)
def test_white_noise_is_recovered(seed: int, name: str) -> None:
    """Sigma to 8% at all depths seen, outliers and missing returns to a tenth of their number or 0.004.

    A window of 1,000 pixels knows log sigma to 0.022, some hundred of them to 0.002: what is left are the
    hems of the planes, and the prior, by which noise grows with depth: one that does not is known to 15%.
    """
    noise = NOISES[name]
    found = estimated(np.random.default_rng(seed), noise)
    ratio = standard_deviation(found.noise, DEPTHS_M) / standard_deviation(noise, DEPTHS_M)
    assert np.abs(np.log(ratio)).max() < (0.15 if name == "one as good near as far" else 0.08)
    assert found.noise.outlier_probability == pytest.approx(noise.outlier_probability, rel=0.1, abs=0.004)
    assert found.noise.none_hit_probability == pytest.approx(noise.none_hit_probability, rel=0.1)
    assert found.correlation.x_px == found.correlation.y_px == 0.0
    assert found.windows > FEW_WINDOWS


@pytest.mark.parametrize("length_px", [1.5, 3.0, 5.0])
def test_correlated_noise_is_recovered(seed: int, length_px: float) -> None:
    """Lengths to 20%, sigma to 10%, of which windows' residuals alone lack up to a third."""
    noise = DepthNoise(outlier_probability=0.01, none_hit_probability=0.03)
    found = estimated(np.random.default_rng(seed), noise, correlation=float(np.exp(-1 / length_px)))
    ratio = standard_deviation(found.noise, DEPTHS_M) / standard_deviation(noise, DEPTHS_M)
    assert np.abs(np.log(ratio)).max() < 0.10
    assert found.correlation.x_px == pytest.approx(length_px, rel=0.2)
    assert found.correlation.y_px == pytest.approx(length_px, rel=0.2)


def test_gravel_in_half_of_the_image_does_no_harm(seed: int) -> None:
    """Sigma to 10% all the same."""
    found = estimated(np.random.default_rng(seed), DepthNoise(), bumpy=0.5)
    ratio = standard_deviation(found.noise, DEPTHS_M) / standard_deviation(DepthNoise(), DEPTHS_M)
    assert np.abs(np.log(ratio)).max() < 0.10


def test_one_distance_tells_the_size_of_sigma_and_not_its_growth(seed: int) -> None:
    """Of a wall at 1 m with thrice the usual noise: farther off, too, to a quarter."""
    rng = np.random.default_rng(seed)
    noise = DepthNoise(sigma_base_m=0.0036, sigma_growth_per_m=0.0057, none_hit_probability=0.05)
    wall_m = 1.0 + standard_deviation(noise, np.ones((300, 400))) * rng.normal(size=(300, 400))
    found = estimate_noise(WindowResiduals.of(wall_m.astype(np.float32), CAMERA))
    at_wall, far = standard_deviation(found.noise, np.array([1.0, 3.0])) / standard_deviation(
        DepthNoise(), np.array([1.0, 3.0])
    )
    assert at_wall == pytest.approx(3.0, rel=0.05)
    assert far == pytest.approx(3.0, rel=0.25)


@pytest.mark.parametrize("depth_m", [np.zeros((300, 400), np.float32), None], ids=["nothing", "gravel"])
def test_images_without_smooth_parts_tell_nothing(seed: int, depth_m: NDArray[np.float32] | None) -> None:
    """The usual sensor is kept within a factor of two, and few windows are told."""
    if depth_m is None:
        depth_m = np.random.default_rng(seed).uniform(0.5, 3.0, (300, 400)).astype(np.float32)
    found = estimate_noise(WindowResiduals.of(depth_m, CAMERA))
    ratio = standard_deviation(found.noise, DEPTHS_M) / standard_deviation(DepthNoise(), DEPTHS_M)
    assert np.abs(np.log(ratio)).max() < np.log(2)
    assert found.windows < FEW_WINDOWS


def test_the_range_reaches_beyond_the_farthest_return() -> None:
    """Else such returns would be impossible."""
    depth_m = np.full((300, 400), 14.0, np.float32)
    found = estimate_noise(WindowResiduals.of(depth_m, CAMERA), replace(DepthNoise(), max_range_m=10.0))
    assert found.noise.max_range_m == 17.5


@pytest.mark.parametrize("lengths", [(0.1, 0.1), (2.0, 3.5), (6.0, 1.0)])
def test_covariances_of_residuals_are_those_of_the_projection(lengths: tuple[float, float]) -> None:
    """(I - H) S (I - H) of a window of 16 pixels, built whole, to 1e-9."""
    side = 16
    rows, columns = np.divmod(np.arange(side**2), side)
    apart = np.hypot((columns[:, None] - columns) / lengths[0], (rows[:, None] - rows) / lengths[1])
    basis = quadratic_basis(side)
    keeps = np.eye(side**2) - basis @ basis.T
    covariance = keeps @ np.exp(-apart) @ keeps
    found = residual_covariances(*lengths, side)
    for lag in range(LAGS + 1):
        beside = (rows[:, None] == rows) & (columns[:, None] - columns == lag)
        below = (columns[:, None] == columns) & (rows[:, None] - rows == lag)
        assert found[0, lag] == pytest.approx(covariance[beside].mean(), abs=1e-9)
        assert found[1, lag] == pytest.approx(covariance[below].mean(), abs=1e-9)
