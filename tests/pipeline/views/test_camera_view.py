"""Points are drawn as balls that close surfaces, and noise does not hide them."""

import numpy as np

from pipeline.views.camera_view import point_radii_m


def test_balls_close_surfaces_near_and_far_and_noise_is_small() -> None:
    """Pixels of a hundredth of a radian see walls at 1 and 3 m; five of them tell 0.3 m."""
    pixels = np.stack(np.meshgrid(np.arange(-30, 30), np.arange(-20, 20)), axis=-1).reshape(-1, 2) / 100
    rays = np.insert(pixels, 2, 1.0, axis=1)
    depth_m = np.where(pixels[:, 0] < 0, 1.0, 3.0)
    noisy = np.array([65, 490, 1030, 1575, 2210])
    depth_m[noisy] = 0.3
    radii_m = point_radii_m((rays * depth_m[:, None]).astype(np.float32), np.zeros((1, 3)))

    wall = np.setdiff1d(np.arange(len(rays)), noisy)
    np.testing.assert_array_less(0.5 * 0.01 * depth_m[wall], radii_m[wall] + 1e-6)
    assert radii_m[noisy].max() < 0.01
