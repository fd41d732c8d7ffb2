"""Planes of flat regions against the plane that the depth was made of."""

import numpy as np
import pytest

from recordings.types import DepthNoise, Frame
from slam.keyframes.depth_view import FINE_CANVAS, view_of_frame
from slam.keyframes.planes import region_planes
from slam.keyframes.rendering import depth_on_rays
from slam.keyframes.surfels import surfel_image
from tests.slam import box_room

NOISE = DepthNoise()
PLANE = np.asarray([0.15, -0.2, 0.6])
"""N . P = 1, one to two metres away over the image."""


def _depth() -> np.ndarray:
    intrinsics = box_room.INTRINSICS
    v, u = np.mgrid[0 : intrinsics.height, 0 : intrinsics.width]
    rays = np.stack(
        [(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones(u.shape)]
    )
    return (1.0 / np.tensordot(PLANE, rays, 1)).astype(np.float32)


def _angles_rad(planes: np.ndarray) -> np.ndarray:
    cosine = PLANE @ planes / np.linalg.norm(planes, axis=0) / np.linalg.norm(PLANE)
    return np.arccos(np.clip(cosine, -1.0, 1.0))


@pytest.mark.parametrize("noisy", [False, True])
def test_a_flat_region_has_one_plane(noisy: bool):
    """Exact depth gives the plane itself; noise turns it by less than a fifth of a degree."""
    depth = _depth()
    if noisy:
        rng = np.random.default_rng(3)
        sigma = NOISE.sigma_base_m + NOISE.sigma_growth_per_m * (depth - 0.4) ** 2
        depth = (depth + sigma * rng.normal(size=depth.shape)).astype(np.float32)
    view = view_of_frame(Frame(time_ns=0, depth_m=depth), box_room.INTRINSICS, FINE_CANVAS)

    planes, sizes = (np.asarray(leaf) for leaf in region_planes(view, NOISE))

    rows, columns = depth.shape
    inner = np.zeros(sizes.shape, bool)
    inner[40 : rows - 40, 40 : columns - 40] = True
    assert (sizes[inner] > 1000).mean() > 0.98
    flat = planes[:, inner & (sizes > 1000)]
    if not noisy:
        np.testing.assert_allclose(flat, np.tile(PLANE[:, None], flat.shape[1]), atol=1e-4)
        return
    assert np.median(_angles_rad(flat)) < 0.003
    offsets = 1.0 / np.linalg.norm(flat, axis=0) - 1.0 / np.linalg.norm(PLANE)
    assert np.median(np.abs(offsets)) < 0.001


def test_a_wall_is_known_as_well_as_its_variance_says():
    """A tenth of a pixel's variance is claimed of flat regions, and their planes err by no more than that."""
    rng = np.random.default_rng(4)
    true = _depth()
    sigma = NOISE.sigma_base_m + NOISE.sigma_growth_per_m * (true - 0.4) ** 2
    noisy = (true + sigma * rng.normal(size=true.shape)).astype(np.float32)
    view = view_of_frame(Frame(time_ns=0, depth_m=noisy), box_room.INTRINSICS, FINE_CANVAS)

    surface = surfel_image(view, NOISE)

    inner = np.s_[40 : true.shape[0] - 40, 40 : true.shape[1] - 40]
    depth = np.asarray(depth_on_rays(surface.planes, surface.rays))[: true.shape[0], : true.shape[1]]
    variance = np.asarray(surface.variance_m2)[: true.shape[0], : true.shape[1]]
    squared = ((depth - true) ** 2 / variance)[inner]
    np.testing.assert_allclose(np.median((variance / sigma**2)[inner]), 0.1, rtol=0.05)
    assert 0.01 < squared.mean() < 1.0
