"""The pose graph against dense linear algebra."""

from dataclasses import replace

import numpy as np
import pytest

from slam.pose_graph import sparse_gaussian
from slam.pose_graph.sparse_gaussian import (
    JointTerm,
    PoseGraph,
    connected_to_first,
    damped_step,
    draws,
    marginals,
)
from slam.registration.alignment import STIFFNESS
from tests.statistical import assert_mean

RING = np.asarray([(0, 1), (1, 2), (2, 3), (3, 4), (4, 0), (0, 2)])


def _graph(rng: np.random.Generator, *, jointly: bool = False) -> PoseGraph:
    """Terms of rank eight: twelve coordinates of two keyframes, of which none is seen by itself alone."""
    jacobian = rng.normal(scale=20.0, size=(len(RING), 8, 12))
    of_all = rng.normal(scale=20.0, size=(10, 30))
    joint = JointTerm(precision=of_all.T @ of_all, gradient=rng.normal(scale=50.0, size=30))
    return PoseGraph(
        keyframes=5,
        pairs=RING,
        precision=jacobian.transpose(0, 2, 1) @ jacobian,
        gradient=rng.normal(scale=50.0, size=(len(RING), 12)),
        joint=joint if jointly else None,
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
    dense, slope = precision.reshape(30, 30), gradient.ravel()
    if graph.joint is not None:
        dense, slope = dense + graph.joint.precision, slope + graph.joint.gradient
    return dense[6:, 6:], slope[6:]


@pytest.mark.parametrize("jointly", [False, True])
def test_a_step_solves_the_damped_normal_equations(seed, jointly):
    """The first keyframe stays; limit: rounding of double precision."""
    graph = _graph(np.random.default_rng(seed), jointly=jointly)
    precision, gradient = _dense(graph)

    step = damped_step(graph, damping=30.0)

    np.testing.assert_array_equal(step[0], 0.0)
    expected = -np.linalg.solve(precision + 30.0 * np.eye(24), gradient)
    np.testing.assert_allclose(step[1:].ravel(), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("jointly", [False, True])
def test_draws_have_the_covariance_of_dense_algebra(key, seed, jointly):
    """Whitened by the inverse of the summed precision, products of draws are those of unit Gaussians."""
    graph = _graph(np.random.default_rng(seed), jointly=jointly)
    precision = _dense(graph)[0] + STIFFNESS * np.eye(24)

    drawn = draws(key, graph, 4000)

    assert not drawn[:, 0].any()
    whitened = drawn[:, 1:].reshape(4000, 24) @ np.linalg.cholesky(precision)
    products = np.einsum("kn,km->knm", whitened, whitened)
    assert_mean(products, np.eye(24), detectable=0.2)


@pytest.mark.parametrize("columns", [12, 600])
def test_marginals_are_blocks_of_the_dense_inverse(seed, columns, monkeypatch):
    """The first keyframe is certain, however many columns are solved at once. Limit: rounding."""
    monkeypatch.setattr(sparse_gaussian, "MARGINAL_COLUMNS", columns)
    graph = _graph(np.random.default_rng(seed))
    inverse = np.linalg.inv(_dense(graph)[0] + STIFFNESS * np.eye(24)).reshape(4, 6, 4, 6)

    covariances = marginals(graph)

    np.testing.assert_array_equal(covariances[0], 0.0)
    np.testing.assert_allclose(covariances[1:], inverse[range(4), :, range(4)], rtol=1e-7, atol=1e-12)


def test_keyframes_apart_are_not_tied_to_the_first(seed):
    """A pair of their own, or no term at all: only the first ring's keyframes are tied."""
    graph = replace(_graph(np.random.default_rng(seed)), keyframes=8)
    split = replace(graph, pairs=np.asarray([(0, 1), (1, 2), (0, 2), (5, 6), (6, 5), (2, 1)]))

    assert connected_to_first(graph).tolist() == [True] * 5 + [False] * 3
    assert connected_to_first(split).tolist() == [True] * 3 + [False] * 5
    assert connected_to_first(_graph(np.random.default_rng(seed), jointly=True)).all()
