"""The pose graph against dense linear algebra."""

import numpy as np

from slam.alignment import STIFFNESS
from slam.pose_graph import PoseGraph, damped_step, draws
from tests.statistical import assert_mean

RING = np.asarray([(0, 1), (1, 2), (2, 3), (3, 4), (4, 0), (0, 2)])


def _graph(rng: np.random.Generator) -> PoseGraph:
    """Terms of rank eight: twelve coordinates of two keyframes, of which none is seen by itself alone."""
    jacobian = rng.normal(scale=20.0, size=(len(RING), 8, 12))
    return PoseGraph(
        keyframes=5,
        pairs=RING,
        precision=jacobian.transpose(0, 2, 1) @ jacobian,
        gradient=rng.normal(scale=50.0, size=(len(RING), 12)),
    )


def _dense(graph: PoseGraph) -> tuple[np.ndarray, np.ndarray]:
    """Precision (24, 24) and gradient (24,) of all keyframes but the first."""
    precision, gradient = np.zeros((5, 6, 5, 6)), np.zeros((5, 6))
    for (i, j), of_term, slope in zip(graph.pairs, graph.precision, graph.gradient, strict=True):
        blocks = of_term.reshape(2, 6, 2, 6)
        for a, first in enumerate((i, j)):
            gradient[first] += slope.reshape(2, 6)[a]
            for b, second in enumerate((i, j)):
                precision[first, :, second] += blocks[a, :, b]
    return precision.reshape(30, 30)[6:, 6:], gradient.ravel()[6:]


def test_a_step_solves_the_damped_normal_equations(seed):
    """The first keyframe stays; limit: rounding of double precision."""
    graph = _graph(np.random.default_rng(seed))
    precision, gradient = _dense(graph)

    step = damped_step(graph, damping=30.0)

    np.testing.assert_array_equal(step[0], 0.0)
    expected = -np.linalg.solve(precision + 30.0 * np.eye(24), gradient)
    np.testing.assert_allclose(step[1:].ravel(), expected, rtol=1e-9, atol=1e-12)


def test_draws_have_the_covariance_of_dense_algebra(key, seed):
    """Whitened by the inverse of the summed precision, products of draws are those of unit Gaussians."""
    graph = _graph(np.random.default_rng(seed))
    precision = _dense(graph)[0] + STIFFNESS * np.eye(24)

    drawn = draws(key, graph, 4000)

    assert not drawn[:, 0].any()
    whitened = drawn[:, 1:].reshape(4000, 24) @ np.linalg.cholesky(precision)
    products = np.einsum("kn,km->knm", whitened, whitened)
    assert_mean(products, np.eye(24), detectable=0.2)
