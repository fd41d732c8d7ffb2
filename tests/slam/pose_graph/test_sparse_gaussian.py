"""The pose graph against dense linear algebra."""

from dataclasses import replace

import numpy as np
import pytest

from slam.pose_graph.sparse_gaussian import (
    FieldTerm,
    JointTerm,
    PoseGraph,
    conditional_marginals,
    connected_to_first,
    damped_step,
    draws,
    field_posterior,
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


SHARED = 4


def _with_field(rng: np.random.Generator, *, jointly: bool = False) -> tuple[PoseGraph, np.ndarray]:
    """A graph whose terms share four coordinates, and its whole precision (30 + 4, 30 + 4) as one matrix."""
    graph = _graph(rng, jointly=jointly)
    rows = []
    for pair in RING:
        row = np.zeros((8, 30 + SHARED))
        index = np.concatenate([6 * one + np.arange(6) for one in pair])
        row[:, index], row[:, 30:] = rng.normal(scale=20.0, size=(8, 12)), rng.normal(size=(8, SHARED))
        rows.append(row)
    terms = [row.T @ row for row in rows]
    whole = np.sum(terms, axis=0)
    whole[30:, 30:] += np.eye(SHARED)
    blocks = [
        term[np.ix_(index, index)]
        for term, pair in zip(terms, RING, strict=True)
        for index in [np.concatenate([6 * one + np.arange(6) for one in pair])]
    ]
    field = FieldTerm(precision=whole[30:, 30:], gradient=rng.normal(size=SHARED), cross=whole[:30, 30:])
    graph = replace(graph, precision=np.stack(blocks), field=field)
    if graph.joint is not None:
        whole[:30, :30] += graph.joint.precision
    return graph, whole


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

    step, _ = damped_step(graph, damping=30.0)

    np.testing.assert_array_equal(step[0], 0.0)
    expected = -np.linalg.solve(precision + 30.0 * np.eye(24), gradient)
    np.testing.assert_allclose(step[1:].ravel(), expected, rtol=1e-9, atol=1e-12)


def test_several_keyframes_may_be_fixed(key, seed):
    """Step, marginals and draws are those of the others alone; limit: rounding."""
    graph = replace(_graph(np.random.default_rng(seed)), fixed=3)
    precision, gradient = _dense(graph)
    precision, gradient = precision[12:, 12:], gradient[12:]

    step, _ = damped_step(graph, damping=30.0)
    covariances, drawn = conditional_marginals(graph), draws(key, graph, 10)

    for of_fixed in (step[:3], covariances[:3], drawn[:, :3]):
        assert not of_fixed.any()
    expected = -np.linalg.solve(precision + 30.0 * np.eye(12), gradient)
    np.testing.assert_allclose(step[3:].ravel(), expected, rtol=1e-9, atol=1e-12)
    inverse = np.linalg.inv(precision + STIFFNESS * np.eye(12)).reshape(2, 6, 2, 6)
    np.testing.assert_allclose(covariances[3:], inverse[range(2), :, range(2)], rtol=1e-7, atol=1e-12)


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


def test_marginals_are_blocks_of_the_dense_inverse(seed):
    """The first keyframe is certain. Limit: rounding."""
    graph = _graph(np.random.default_rng(seed))
    inverse = np.linalg.inv(_dense(graph)[0] + STIFFNESS * np.eye(24)).reshape(4, 6, 4, 6)

    covariances = conditional_marginals(graph)

    np.testing.assert_array_equal(covariances[0], 0.0)
    np.testing.assert_allclose(covariances[1:], inverse[range(4), :, range(4)], rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("jointly", [False, True])
def test_a_shared_field_is_solved_with_the_poses(seed, jointly):
    """Step, marginals and draws' covariance against one dense matrix of poses and field."""
    graph, whole = _with_field(np.random.default_rng(seed), jointly=jointly)
    assert graph.field is not None
    slope = np.append(_dense(graph)[1], graph.field.gradient)
    free = whole[6:, 6:]
    damped = free + np.diag(np.append(np.full(24, 30.0), np.zeros(SHARED)))

    step, of_field = damped_step(graph, damping=30.0)

    expected = -np.linalg.solve(damped, slope)
    np.testing.assert_allclose(step[1:].ravel(), expected[:24], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(of_field, expected[24:], rtol=1e-6)
    inverse = np.linalg.inv(free + np.diag(np.append(np.full(24, STIFFNESS), np.zeros(SHARED))))
    posterior, conditional = field_posterior(graph), conditional_marginals(graph)
    carried = posterior.sensitivity @ posterior.covariance @ posterior.sensitivity.transpose(0, 2, 1)
    blocks = inverse[:24, :24].reshape(4, 6, 4, 6)[range(4), :, range(4)]
    np.testing.assert_allclose((conditional + carried)[1:], blocks, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(posterior.covariance, inverse[24:, 24:], rtol=1e-6)
    np.testing.assert_array_equal((conditional + carried)[0], 0.0)


def test_a_shared_offset_is_told_and_tempering_would_not(seed):
    """One coordinate of a camera from six pixels of two images that share two nodes' error, by quadrature.

    The graph's variance within 2%; the variance tempered by the spread of the pixels' scores is not a tenth.
    """
    rng = np.random.default_rng(seed)
    slopes, sigma, prior_sd = rng.uniform(0.8, 1.2, 6), 0.002, 0.008
    weights = np.stack([np.linspace(1.0, 0.4, 6), np.linspace(0.0, 0.6, 6)])
    jacobian, factor = np.zeros((6, 12)), prior_sd * weights
    jacobian[:, 6] = slopes
    gaps = weights.T @ np.array([0.006, 0.009]) + sigma * rng.normal(size=6)
    graph = PoseGraph(
        keyframes=2,
        pairs=np.asarray([(0, 1)]),
        precision=(jacobian.T @ jacobian / sigma**2)[None],
        gradient=(jacobian.T @ gaps / sigma**2)[None],
        field=FieldTerm(
            precision=np.eye(2) + factor @ factor.T / sigma**2,
            gradient=factor @ gaps / sigma**2,
            cross=jacobian.T @ factor.T / sigma**2,
        ),
    )
    x, first, second = np.meshgrid(
        np.linspace(-0.05, 0.05, 401), *2 * [np.linspace(-5, 5, 121)], indexing="ij"
    )
    residual = gaps + slopes * x[..., None] + first[..., None] * factor[0] + second[..., None] * factor[1]
    log_density = -0.5 * ((residual / sigma) ** 2).sum(-1) - 0.5 * (first**2 + second**2)
    mass = np.exp(log_density - log_density.max()).sum((1, 2))
    places = x[:, 0, 0]
    mean = (mass @ places) / mass.sum()
    exact = (mass @ (places - mean) ** 2) / mass.sum()

    posterior = field_posterior(graph)
    carried = posterior.sensitivity @ posterior.covariance @ posterior.sensitivity.transpose(0, 2, 1)
    told = (conditional_marginals(graph) + carried)[1, 0, 0]

    assert told == pytest.approx(exact, rel=0.02)
    assert damped_step(graph, STIFFNESS)[0][1, 0] == pytest.approx(mean, abs=0.02 * np.sqrt(exact))
    curvature = (slopes**2).sum() / sigma**2
    best = -(slopes @ gaps) / (slopes @ slopes)
    scores = slopes * (gaps + slopes * best) / sigma**2
    assert (scores**2).sum() / curvature**2 < 0.1 * exact


def test_keyframes_apart_are_not_tied_to_the_first(seed):
    """A pair of their own, or no term at all: only the first ring's keyframes are tied."""
    graph = replace(_graph(np.random.default_rng(seed)), keyframes=8)
    split = replace(graph, pairs=np.asarray([(0, 1), (1, 2), (0, 2), (5, 6), (6, 5), (2, 1)]))

    assert connected_to_first(graph).tolist() == [True] * 5 + [False] * 3
    assert connected_to_first(split).tolist() == [True] * 3 + [False] * 5
    assert connected_to_first(_graph(np.random.default_rng(seed), jointly=True)).all()
