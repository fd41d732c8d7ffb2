"""Errors of real depth cameras: correlations, holes, steps and scale as they are asked for."""

from dataclasses import replace

import jax
import numpy as np

from pipeline.synthesis.sensor import DepthSensor
from pipeline.synthesis.sensor_errors import clustered, correlated_normals
from pipeline.synthesis.world import View
from pipeline.synthesis.worlds import REAL_CORRELATION
from recordings.types import NO_RETURN, DepthNoise
from tests.statistical import assert_mean

SHAPE = (48, 64)
DRAWS = 400
EXACT = DepthSensor(
    noise=DepthNoise(outlier_probability=0.0, none_hit_probability=0.0), edge_none_probability=0.0
)


def wall(depth_m: float, shape: tuple[int, int] = SHAPE, cosine: float = 0.9) -> View:
    """A plane that the camera looks at."""
    return View(
        depth_m=np.full(shape, depth_m, np.float32),
        cos_incidence=np.full(shape, cosine, np.float32),
        part=np.zeros(shape, np.int32),
        rgb=np.zeros((*SHAPE, 3), np.float32),
    )


def test_neighbours_correlate_as_asked(key: jax.Array) -> None:
    """0.9, 0.7, 0.6 at 1, 2, 3 pixels along rows and columns, unit variance; false alarm 1e-6."""
    products = []
    for draw in jax.random.split(key, DRAWS):
        field = correlated_normals(draw, SHAPE, REAL_CORRELATION).astype(np.float64)
        row = [np.mean(field**2)]
        row += [np.mean(field[:, :-lag] * field[:, lag:]) for lag in (1, 2, 3)]
        row += [np.mean(field[:-lag] * field[lag:]) for lag in (1, 2, 3)]
        products.append(row)
    # the nearest covariance to the three numbers, which alone are none in two dimensions
    assert_mean(np.array(products), [1, *REAL_CORRELATION, *REAL_CORRELATION], detectable=0.05)


def test_holes_have_their_share_and_hang_together(key: jax.Array) -> None:
    """A fifth of the pixels; most neighbours of a hole are holes."""
    first, second = [], []
    for draw in jax.random.split(key, DRAWS):
        holes = clustered(draw, SHAPE, 0.2, 4.0)
        first.append(holes.mean())
        second.append((holes[:, 1:] & holes[:, :-1]).mean())
    assert_mean(np.array(first), 0.2, detectable=0.03)
    assert np.mean(second) > 0.6 * 0.2


def test_a_sensor_with_correlation_keeps_its_deviation(key: jax.Array) -> None:
    """The noise of each pixel is that of the density; only neighbours differ less."""
    sensor = replace(EXACT, correlation=REAL_CORRELATION, quantisation_m=0.0)
    error = sensor.measure(key, wall(1.0, (480, 640))).astype(np.float64) - 1.0
    sigma = 0.0012 + 0.0019 * 0.6**2
    assert abs(error.std() / sigma - 1) < 0.1
    assert np.corrcoef(error[:, 1:].ravel(), error[:, :-1].ravel())[0, 1] > 0.85


def test_steps_grow_with_distance_and_scale_is_the_cameras_own(key: jax.Array) -> None:
    """Depths are multiples of 0.5 mm + 1.2 mm z^2 nearly; two images of a camera are too long alike."""
    still = replace(EXACT, noise=replace(EXACT.noise, sigma_base_m=1e-6, sigma_growth_per_m=0.0))
    first, second, camera = jax.random.split(key, 3)
    stepped = replace(still, quantisation_m=0.0005, quantisation_growth_per_m=0.0012)
    ramp = replace_depth(wall(1.0), np.linspace(1.9, 2.1, SHAPE[1], dtype=np.float32)[None, :])
    levels = np.unique(stepped.measure(first, ramp))
    assert 0.004 < np.median(np.diff(levels)) < 0.0065
    long = replace(still, quantisation_m=0.0, scale_error=0.05)
    measured = long.measure(second, wall(1.0), None, long.drawn_scale(camera))
    assert np.ptp(measured) < 2e-5
    assert abs(measured[0, 0] - 1) > 1e-4
    assert still.drawn_scale(camera) == 1.0


def test_dark_and_shining_surfaces_have_holes(key: jax.Array) -> None:
    """Only where they are dark, or met straight on."""
    sensor = replace(EXACT, dark_none_probability=0.5, shine_none_probability=0.5)
    brightness = np.ones(SHAPE)
    brightness[:, :32] = 0.1
    first, second = jax.random.split(key)
    none = sensor.measure(first, wall(1.0), brightness) == NO_RETURN
    assert 0.2 < none[:, :32].mean() < 0.8
    assert not none[:, 32:].any()
    assert 0.2 < (sensor.measure(second, wall(1.0, cosine=1.0), np.ones(SHAPE)) == NO_RETURN).mean() < 0.8


def replace_depth(view: View, depth_m: np.ndarray) -> View:
    """The same with other depths."""
    return View(
        depth_m=np.broadcast_to(depth_m, view.depth_m.shape).astype(np.float32),
        cos_incidence=view.cos_incidence,
        part=view.part,
        rgb=np.zeros((*SHAPE, 3), np.float32),
    )
