"""The support plane is found where it is, whatever stands on it and however the camera bends it."""

import numpy as np
import pytest

from scene.detection import clusters, support_plane

CAMERA_FROM_TABLE = np.array([[1, 0, 0, 0.02], [0, -0.8, -0.6, 0.1], [0, 0.6, -0.8, 0.9], [0, 0, 0, 1.0]])


def in_camera(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) of the table's frame in the camera's."""
    return points @ CAMERA_FROM_TABLE[:3, :3].T + CAMERA_FROM_TABLE[:3, 3]


def surface(rng: np.random.Generator, bend_m: float) -> np.ndarray:
    """A table of 80 x 60 cm in its own frame, its corners `bend_m` higher than its middle."""
    points = rng.uniform([-0.4, -0.3, 0], [0.4, 0.3, 0], (20_000, 3))
    points[:, 2] = bend_m * ((points[:, 0] / 0.4) ** 2 + (points[:, 1] / 0.3) ** 2) / 2
    return points + rng.normal(0, 0.001, points.shape)


@pytest.mark.parametrize("bend_m", [0.0, 0.01])
def test_heights_over_the_seen_table(seed: int, bend_m: float) -> None:
    """The table at height 0, a block on it at its own, to 2 mm; normal towards the camera."""
    rng = np.random.default_rng(seed)
    block = rng.uniform([-0.05, -0.05, 0.1], [0.05, 0.05, 0.1], (1500, 3))
    floor = rng.uniform([-1, -1, -0.7], [1, 1, -0.7], (8000, 3))
    flat = surface(rng, bend_m)
    table = support_plane(in_camera(np.concatenate([flat, block, floor])), 1, lambda _: True)
    assert table is not None
    assert np.abs(table.heights(in_camera(flat))).max() < 0.002 + 4 * 0.001
    assert abs(np.median(table.heights(in_camera(block))) - 0.1) < 0.002
    np.testing.assert_allclose(table.camera_from_table[:3, 2], CAMERA_FROM_TABLE[:3, 2], atol=0.02)
    np.testing.assert_allclose(table.half_size_m, [0.4, 0.3], atol=0.02)


def test_a_cloud_without_anything_on_a_plane_has_no_table(seed: int) -> None:
    """A bare wall supports nothing."""
    wall = np.random.default_rng(seed).uniform([-1, -1, 2], [1, 1, 2], (5000, 3))
    assert support_plane(wall, 1, lambda _: True) is None


def test_clusters_come_apart_at_the_finer_scale(seed: int) -> None:
    """Two balls 3 cm apart are two clusters at 1 cm and one at 4 cm, the larger first."""
    rng = np.random.default_rng(seed)
    balls = rng.uniform(-0.02, 0.02, (2, 400, 3))
    balls[1, :, 0] += 0.07
    centres = clusters(balls.reshape(-1, 3), (0.01, 0.04))
    np.testing.assert_allclose(centres[0], [0.035, 0, 0], atol=0.003)
    np.testing.assert_allclose(np.sort(centres[:, 0]), [0.0, 0.035, 0.07], atol=0.003)
