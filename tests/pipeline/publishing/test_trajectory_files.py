"""Trajectories read back by the format's definition are the poses that were written."""

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.publishing.trajectory_files import kitti_lines, tum_lines


def poses(seed: int, count: int) -> np.ndarray:
    """Random poses (count, 4, 4)."""
    rng = np.random.default_rng(seed)
    matrices = np.tile(np.eye(4), (count, 1, 1))
    matrices[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    matrices[:, :3, 3] = rng.normal(size=(count, 3))
    return matrices


def test_tum(seed: int) -> None:
    """Stamps to the nanosecond, translation, quaternion x y z w."""
    truth = poses(seed, 5)
    stamps = 1_700_000_000_123_456_789 + np.arange(5) * 33_333_333
    rows = [line.split() for line in tum_lines(stamps, truth).splitlines()]

    assert [int(row[0].replace(".", "")) for row in rows] == stamps.tolist()
    values = np.array([row[1:] for row in rows], float)
    np.testing.assert_allclose(values[:, :3], truth[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(Rotation.from_quat(values[:, 3:]).as_matrix(), truth[:, :3, :3], atol=1e-8)


def test_kitti(seed: int) -> None:
    """Twelve numbers, the upper rows of the matrix."""
    truth = poses(seed, 4)
    values = np.array([line.split() for line in kitti_lines(truth).splitlines()], float)

    np.testing.assert_allclose(values.reshape(4, 3, 4), truth[:, :3], atol=1e-9)
