"""The scale of the distortion field's prior, beside exact algebra of a linear Gaussian model."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import softmax

from slam.pose_graph.distortion_scale import SCALES, scaled_field, unseen_field
from slam.pose_graph.sparse_gaussian import FieldPosterior

COORDINATES = 5


def _posterior(design: np.ndarray, data: np.ndarray) -> tuple[FieldPosterior, np.ndarray]:
    """Of coordinates under unit Gaussians, data = design @ coordinates + unit noise; and its mode."""
    covariance = np.asarray(np.linalg.inv(np.eye(COORDINATES) + design.T @ design), np.float64)
    none = np.zeros((1, 6, COORDINATES))
    return FieldPosterior(covariance=covariance, sensitivity=none), covariance @ design.T @ data


@pytest.mark.parametrize("true_scale", [0.0, 0.3, 1.5])
def test_moments_are_those_of_the_mixture_over_scales(seed, true_scale):
    """Each scale's evidence from the data's own density, its moments from the normal equations."""
    rng = np.random.default_rng(seed)
    design = 3.0 * rng.normal(size=(8, COORDINATES)) * np.asarray([1.0, 1.0, 1.0, 0.1, 0.0])
    data = design @ (true_scale * rng.normal(size=COORDINATES)) + rng.normal(size=8)

    field = scaled_field(*_posterior(design, data), SCALES)

    log_evidence, means, seconds = [], [], []
    for scale in SCALES:
        marginal = np.eye(8) + scale**2 * design @ design.T
        log_evidence.append(stats.multivariate_normal(np.zeros(8), marginal).logpdf(data))
        covariance = np.linalg.inv(np.eye(COORDINATES) / scale**2 + design.T @ design)
        means.append(covariance @ design.T @ data)
        seconds.append(covariance + np.outer(means[-1], means[-1]))
    shares = softmax(log_evidence)
    mean = shares @ np.stack(means)
    assert field.scale == pytest.approx(np.sqrt(shares @ np.square(SCALES)), rel=1e-6)
    np.testing.assert_allclose(field.mean, mean, rtol=1e-6, atol=1e-9)
    expected = np.einsum("s,sij->ij", shares, np.stack(seconds)) - np.outer(mean, mean)
    np.testing.assert_allclose(field.covariance, expected, rtol=1e-6, atol=1e-9)


def test_many_exact_coordinates_tell_their_scale(seed):
    """Within a fifth: sixty squares of one Gaussian know its scale to a tenth, 1 in 20 draws is two off.

    With a fifth the false alarm rate is below 0.03 a seed, and seeds are fixed.
    """
    coordinates = 0.25 * np.random.default_rng(seed).normal(size=60)
    sharp = FieldPosterior(covariance=1e-6 * np.eye(60), sensitivity=np.zeros((1, 6, 60)))

    field = scaled_field(sharp, coordinates, SCALES)

    assert field.scale == pytest.approx(0.25, rel=0.2)


def test_one_scale_is_the_prior_as_it_is_given(seed):
    """A sensor's own profile is not scaled; where nothing was seen the prior is told."""
    rng = np.random.default_rng(seed)
    posterior, mode = _posterior(rng.normal(size=(8, COORDINATES)), rng.normal(size=8))

    field, unseen = scaled_field(posterior, mode, (1.0,)), unseen_field(COORDINATES, (1.0,))

    assert field.scale == pytest.approx(1.0)
    np.testing.assert_allclose(field.mean, mode)
    np.testing.assert_allclose(field.covariance, posterior.covariance)
    np.testing.assert_array_equal(unseen.covariance, np.eye(COORDINATES))
