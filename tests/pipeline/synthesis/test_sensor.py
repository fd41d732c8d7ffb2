"""The synthetic sensor measures as its parameters say."""

import jax
import numpy as np
import pytest

from pipeline.synthesis.sensor import DepthSensor
from pipeline.synthesis.world import View
from recordings.types import NO_RETURN, DepthNoise
from tests.statistical import assert_frequencies, assert_mean

SHAPE = (240, 320)


def wall(depth_m: float, cos_incidence: float = 1.0) -> View:
    """An ideal image of one depth and incidence."""
    return View(
        depth_m=np.full(SHAPE, depth_m, np.float32),
        cos_incidence=np.full(SHAPE, cos_incidence, np.float32),
        part=np.zeros(SHAPE, np.int32),
        rgb=np.zeros((*SHAPE, 3), np.float32),
    )


@pytest.mark.parametrize("depth_m", [0.5, 1.4, 3.0])
def test_noise_has_the_stated_mean_and_deviation(key: jax.Array, depth_m: float) -> None:
    """sigma(z) = 1.2 mm + 1.9 mm (z - 0.4)^2, widened by the quantisation's uniform error."""
    sensor = DepthSensor(noise=DepthNoise(outlier_probability=0.0, none_hit_probability=0.0))
    error = sensor.measure(key, wall(depth_m)).astype(np.float64).ravel() - depth_m
    sigma = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    variance = sigma**2 + 0.001**2 / 12

    assert_mean(error, 0.0, detectable=0.1 * sigma)
    assert_mean(error**2, variance, detectable=0.1 * variance)


def test_shares_of_missing_returns_and_outliers(key: jax.Array) -> None:
    """Where a surface is hit, and where nothing is."""
    hit_key, miss_key = jax.random.split(key)
    sensor = DepthSensor(min_range_m=0.0)
    hit = sensor.measure(hit_key, wall(1.0))
    none = (hit == NO_RETURN).sum()
    far = (np.abs(hit - 1.0) > 0.05).sum() - none
    near_share = 0.95 * 0.01 * 0.1 / 10
    assert_frequencies(
        [none, far, hit.size - none - far],
        [0.05, 0.0095 - near_share, 0.9405 + near_share],
    )

    miss = sensor.measure(miss_key, wall(np.inf))
    assert_frequencies([(miss == 0).sum(), (miss > 0).sum()], [0.95 + 0.05 * 5e-5, 0.05 * (1 - 5e-5)])


def test_depth_is_quantised(key: jax.Array) -> None:
    """Every value is a multiple of the step."""
    depth = DepthSensor(quantisation_m=0.004).measure(key, wall(1.0))

    np.testing.assert_allclose(depth / 0.004, np.round(depth / 0.004), atol=1e-3)


def test_grazing_rays_do_not_return(key: jax.Array) -> None:
    """Beyond the limit nothing returns, short of it nearly everything does."""
    beyond_key, short_key = jax.random.split(key)
    sensor = DepthSensor(grazing_limit_deg=70.0)

    assert (sensor.measure(beyond_key, wall(1.0, np.cos(np.radians(71)))) == NO_RETURN).all()
    assert (sensor.measure(short_key, wall(1.0, np.cos(np.radians(69)))) != NO_RETURN).mean() > 0.9


def test_edges_lose_returns_and_slopes_do_not(key: jax.Array) -> None:
    """A jump in depth drops the pixels on both sides of it; a steep plane drops none."""
    step_key, slope_key = jax.random.split(key)
    sensor = DepthSensor(
        noise=DepthNoise(outlier_probability=0.0, none_hit_probability=0.0), edge_none_probability=1.0
    )
    step = wall(1.0)
    step.depth_m[:, 160:] = 1.2
    lost = (sensor.measure(step_key, step) == NO_RETURN).all(axis=0)
    assert lost.nonzero()[0].tolist() == [159, 160]

    slope = wall(1.0)
    slope.depth_m[:] = 1 / np.linspace(0.3, 2.0, SHAPE[1], dtype=np.float32)
    assert not (sensor.measure(slope_key, slope) == NO_RETURN).any()


def test_noise_free_measures_exactly(key: jax.Array) -> None:
    """The ideal depth, and no return where nothing is met or out of range."""
    sensor = DepthSensor(noise_free=True)

    assert (sensor.measure(key, wall(1.23456)) == np.float32(1.23456)).all()
    assert (sensor.measure(key, wall(np.inf)) == NO_RETURN).all()
    assert (sensor.measure(key, wall(0.1)) == NO_RETURN).all()
    assert (sensor.measure(key, wall(12.0)) == NO_RETURN).all()


def test_a_drawn_distortion_is_of_mean_zero_and_bends_depths(key: jax.Array) -> None:
    """The field's nodes have the stated deviation, and 1 / z_measured = 1 / z + d at the corners' nodes."""
    sensor = DepthSensor(noise_free=True, distortion_per_m=2e-3)
    fields = [sensor.drawn_distortion(one) for one in jax.random.split(key, 200)]
    drawn = np.stack([field for field in fields if field is not None])

    measured = sensor.measure(key, wall(2.0), disparity_per_m=drawn[0])

    np.testing.assert_allclose(drawn.mean(axis=(1, 2)), 0.0, atol=1e-15)
    assert_mean((drawn**2).mean(axis=(1, 2)), 2e-3**2 * 62 / 63, detectable=0.1 * 2e-3**2)
    np.testing.assert_allclose(1 / measured[0, 0] - 0.5, drawn[0, 0, 0], atol=2e-4)
    assert DepthSensor().drawn_distortion(key) is None
