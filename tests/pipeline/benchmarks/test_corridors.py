"""The corridor of `bench slam`: the way round it, and that nothing stands on it."""

import numpy as np

from pipeline.benchmarks.corridors import _path, corridor
from recordings.types import NO_RETURN


def test_the_way_round_comes_back_to_its_start():
    """After each side it has turned by a quarter; poses are rotations."""
    side = 5.0
    poses = _path(side, side * np.arange(5.0))

    np.testing.assert_allclose(poses[4], poses[0], atol=1e-9)
    turned = poses[0, :3, :3].T @ poses[1, :3, :3]
    assert abs(poses[1, :3, 2] @ poses[0, :3, 2]) < 0.2
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turned) > 0


def test_no_frame_is_filmed_from_within_a_thing():
    """In every frame most pixels return, from farther than a hand's breadth."""
    case = corridor(10.0, 3, returns=False)

    depths = np.stack([frame.depth_m for frame in case.frames[::10]])
    assert ((depths != NO_RETURN).mean(axis=(1, 2)) > 0.8).all()
    assert np.quantile(depths[depths != NO_RETURN], 0.02) > 0.1
