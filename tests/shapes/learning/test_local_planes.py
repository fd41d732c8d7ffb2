"""Planes of depth images against the planes that made them."""

import jax.numpy as jnp
import numpy as np

from recordings.types import CameraIntrinsics, DepthNoise
from shapes.geometry.camera import Camera
from shapes.learning.local_planes import local_planes
from tests.statistical import assert_mean

INTRINSICS = CameraIntrinsics(width=64, height=48, fx=300.0, fy=300.0, cx=31.5, cy=23.5)
CAMERA = Camera.from_intrinsics(INTRINSICS)
NOISE = DepthNoise()


def slanted(tangent: float) -> np.ndarray:
    """Depth of a plane through (0, 0, 0.8 m) that falls away to the right."""
    columns = (np.arange(INTRINSICS.width) - INTRINSICS.cx) / INTRINSICS.fx
    return np.tile((0.8 / (1 - tangent * columns)).astype(np.float32), (INTRINSICS.height, 1))


def test_a_plane_is_found_exactly() -> None:
    """At every pixel, up to a slope of two, but for the prior on slopes where neighbours are missing."""
    for tangent in (0.0, 0.7, 2.0):
        depth = slanted(tangent)
        planes = local_planes(jnp.asarray(depth), CAMERA, NOISE)
        assert np.asarray(planes.valid).all()
        np.testing.assert_allclose(1 / np.asarray(planes.inverse_depth), depth, rtol=5e-4)


def test_holes_have_no_plane_and_spoil_none() -> None:
    """Pixels without a return are left out."""
    depth = slanted(0.5)
    holed = depth.copy()
    holed[::4, ::5] = 0.0
    planes = local_planes(jnp.asarray(holed), CAMERA, NOISE)
    valid = np.asarray(planes.valid)
    assert (valid == (holed > 0)).all()
    np.testing.assert_allclose(1 / np.asarray(planes.inverse_depth)[valid], depth[valid], rtol=5e-4)


def test_no_plane_bridges_an_edge() -> None:
    """Beside a step of 5 cm every plane stays on its own side."""
    depth = np.full((48, 64), 0.8, np.float32)
    depth[:, 32:] = 0.85
    found = 1 / np.asarray(local_planes(jnp.asarray(depth), CAMERA, NOISE).inverse_depth)
    np.testing.assert_allclose(found, depth, atol=1e-4)


def test_the_covariance_is_that_of_the_errors(seed: int) -> None:
    """Squared errors over their variances have mean at most one, and not far below.

    The plane may bend by its prior, so the variance is an upper bound on a true plane.
    """
    rng = np.random.default_rng(seed)
    depth = slanted(0.5)
    ratios = []
    for _ in range(60):
        noisy = depth + np.float32(0.0012 + 0.0019 * 0.4**2) * rng.normal(size=depth.shape).astype(np.float32)
        planes = local_planes(jnp.asarray(noisy), CAMERA, NOISE)
        error = 1 / np.asarray(planes.inverse_depth) - depth
        ratios.append((error**2 / np.asarray(planes.covariance[0]))[4:-4:4, 4:-4:4].mean())
    assert 0.4 < np.mean(ratios) < 1.0
    assert_mean(np.asarray(ratios), np.mean(ratios), detectable=0.2)


def test_a_round_surface_is_not_read_too_deep(seed: int) -> None:
    """A cylinder of 19 mm, half a metre away, upright and lying, through noise: unbiased along its ridge.

    A plane through 3 x 3 of its pixels, 1.7 mm apart, lies 0.10 mm too deep there.
    """
    rng = np.random.default_rng(seed)
    x = 0.5 * (np.arange(INTRINSICS.width) - INTRINSICS.cx) / INTRINSICS.fx
    round_m = np.sqrt(np.maximum(0.0095**2 - x**2, 0.0))
    profile = np.where(round_m > 0, 0.5095 - round_m, 0.6).astype(np.float32)
    upright = np.tile(profile, (INTRINSICS.height, 1))
    for depth in (upright, upright.T[8:56]):
        ridge = depth < 0.5004
        errors = []
        for _ in range(100):
            noisy = depth + np.float32(0.0012) * rng.normal(size=depth.shape).astype(np.float32)
            found = 1 / np.asarray(local_planes(jnp.asarray(noisy), CAMERA, NOISE).inverse_depth)
            errors.append((found - depth)[ridge].mean())
        print(np.mean(errors), ridge.sum())
        assert_mean(np.array(errors), 0.0, detectable=0.0001)
