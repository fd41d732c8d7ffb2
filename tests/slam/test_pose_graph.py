"""The pose graph against dense linear algebra, and repair of a loop whose drift is known."""

import numpy as np
from scipy.spatial.transform import Rotation

from slam.alignment import STIFFNESS
from slam.pose_graph import PoseGraph, optimum
from slam.rigid import poses_of
from tests.statistical import assert_mean


def _poses(rng: np.random.Generator, count: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[1:, :3, :3] = Rotation.from_rotvec(rng.normal(scale=0.5, size=(count - 1, 3))).as_matrix()
    poses[1:, :3, 3] = rng.normal(size=(count - 1, 3))
    return poses


def _graph(poses: np.ndarray, edges: list[tuple[int, int]], precision: float) -> PoseGraph:
    first, second = np.asarray(edges).T
    return PoseGraph(
        first=first,
        second=second,
        measured=np.array(poses_of(np.linalg.inv(poses[first]) @ poses[second])),
        precision=np.tile(precision * np.eye(6), (len(edges), 1, 1)),
    )


RING = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0), (0, 2)]


def test_agreeing_edges_give_back_the_poses(key, seed):
    """Five poses from centimetres and degrees away; limit: the single precision of poses."""
    rng = np.random.default_rng(seed)
    truth = _poses(rng, 5)
    start = truth.copy()
    start[1:, :3, 3] += rng.normal(scale=0.05, size=(4, 3))
    turn = Rotation.from_rotvec(rng.normal(scale=0.05, size=(4, 3)))
    start[1:, :3, :3] = start[1:, :3, :3] @ turn.as_matrix()

    found = optimum(key, _graph(truth, RING, 1e6), start, draws=1)

    np.testing.assert_allclose(found.poses, truth, atol=2e-5)


def test_a_false_edge_is_not_believed(key, seed):
    """One of seven edges says a metre that the others deny."""
    truth = _poses(np.random.default_rng(seed), 5)
    graph = _graph(truth, [*RING, (1, 3)], 1e6)
    graph.measured[-1, 4:] += 1.0

    found = optimum(key, graph, truth, draws=1)

    np.testing.assert_allclose(found.poses, truth, atol=1e-3)


def test_draws_have_the_covariance_of_dense_algebra(key):
    """Poses that coincide make the graph linear: the inverse of its Laplacian, for each coordinate."""
    poses, precision, draws = np.tile(np.eye(4), (5, 1, 1)), 400.0, 4000
    laplacian = np.zeros((5, 5))
    for first, second in RING:
        step = np.eye(5)[second] - np.eye(5)[first]
        laplacian += precision * np.outer(step, step)
    covariance = np.linalg.inv((laplacian + STIFFNESS * np.eye(5))[1:, 1:])

    found = optimum(key, _graph(poses, RING, precision), poses, draws)

    assert not found.draws[:, 0].any()
    whitened = np.linalg.inv(np.linalg.cholesky(covariance)) @ found.draws[:, 1:]
    products = np.einsum("knd,kmd->kdnm", whitened, whitened)
    assert_mean(products, np.tile(np.eye(4), (6, 1, 1)), detectable=0.2)


def test_nothing_moves_the_only_keyframe(key):
    """A graph may have one pose that edges cannot move."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    found = optimum(key, _graph(poses, [(0, 1)], 1e6), poses, draws=3)
    assert found.draws.shape == (3, 2, 6)
