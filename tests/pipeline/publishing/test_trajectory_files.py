"""Trajectories read back by the format's definition are the poses that were written."""

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.publishing.trajectory_files import path_texts
from shapes.geometry.poses import poses_of
from slam.result import SlamResult


def path(seed: int, count: int, lost: tuple[int, ...] = ()) -> SlamResult:
    """Random poses, some of them of frames that were lost."""
    rng = np.random.default_rng(seed)
    matrices = np.tile(np.eye(4), (count, 1, 1))
    matrices[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    matrices[:, :3, 3] = rng.normal(size=(count, 3))
    return SlamResult(
        times_ns=1_700_000_000_123_456_789 + np.arange(count) * 33_333_333,
        draws=poses_of(matrices)[None].astype(np.float32),
        log_weights=np.zeros(1),
        mean=matrices,
        covariance=np.tile(np.eye(6), (count, 1, 1)),
        degrees_of_freedom=np.asarray(8.0),
        undiscovered=np.asarray(0.0),
        hypotheses=np.ones(count),
        log_evidence=np.zeros(count),
        resampled=np.zeros(count, bool),
        lost=np.isin(np.arange(count), lost),
        explained=np.ones(count),
        disparity_per_m=np.zeros((7, 9)),
        disparity_sd_per_m=np.full((7, 9), 2e-3),
        camera=np.array([640.0, 480.0, 600.0, 600.0, 319.5, 239.5]),
    )


def test_tum(seed: int) -> None:
    """Stamps to the nanosecond, translation, quaternion x y z w; a lost frame is left out."""
    truth = path(seed, 5, lost=(2,))
    rows = [line.split() for line in path_texts(truth)["trajectory.tum"].splitlines()]
    found = [0, 1, 3, 4]

    assert [int(row[0].replace(".", "")) for row in rows] == truth.times_ns[found].tolist()
    values = np.array([row[1:] for row in rows], float)
    np.testing.assert_allclose(values[:, :3], truth.mean[found, :3, 3], atol=1e-9)
    rotations = Rotation.from_quat(values[:, 3:]).as_matrix()
    np.testing.assert_allclose(rotations, truth.mean[found, :3, :3], atol=1e-8)


def test_kitti(seed: int) -> None:
    """Twelve numbers, the upper rows of the matrix; nan where the frame was lost."""
    truth = path(seed, 4, lost=(1,))
    values = np.array(
        [line.split() for line in path_texts(truth)["trajectory.kitti"].splitlines()], float
    ).reshape(4, 3, 4)

    assert np.isnan(values[1]).all()
    np.testing.assert_allclose(values[[0, 2, 3]], truth.mean[[0, 2, 3], :3], atol=1e-9)


def test_lost_frames_are_listed_with_their_stamps(seed: int) -> None:
    """And where all are lost there is no path at all."""
    assert path_texts(path(seed, 4, lost=(1, 3)))["lost.txt"].splitlines() == [
        "1 1700000000.156790122",
        "3 1700000000.223456788",
    ]
    assert path_texts(path(seed, 2, lost=(0, 1)))["trajectory.tum"] == ""
