"""Prior and posterior odds of presence: beta-binomial over the shapes that are asked for."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logit

from scene.model.number_prior import UncertainBinomialNumber

LOG_SHARE_OF_POSES = -20.0
"""Log prior probability of the poses that fit alike: within about 2 mm and 2 degrees, of all on a table."""

LOG_SPINS = math.log(360 / 4)
"""Log of how many times as many poses fit alike of a shape that is round about a line: it spins freely."""


def log_prior_odds(presence: float) -> float:
    """Of an object being there in one pose, up to poses that fit alike, against its being absent."""
    return math.log(presence / (1 - presence)) + LOG_SHARE_OF_POSES


def log_odds_of_presence(
    log_odds_where_seen: ArrayLike, unseen: ArrayLike, presence: float
) -> NDArray[np.float64]:
    """Log posterior odds (N,) of objects, from those of the pose that explains most and of all unseen poses.

    How many of the shapes asked for are there is not known better than by a beta distribution with mean
    `presence`, the weight of SHAPES of them: where most are not, each of the others is less probable. Exact:
    counts of those that are there are beta-binomial, by elementary symmetric polynomials of the ratios.

    Args:
        log_odds_where_seen: (N,) the scene with the object in its best pose against the best one without, if
            it is there with probability `presence`.
        unseen: (N,) share of the prior's poses that leave the images as they are.
        presence: prior probability.
    """
    with np.errstate(divide="ignore"):
        log_unseen = np.log(np.asarray(unseen, np.float64))
    log_ratios = np.logaddexp(np.asarray(log_odds_where_seen) - logit(presence), log_unseen)
    log_sets = UncertainBinomialNumber(presence).log_set_probabilities(len(log_ratios))
    log_without, log_with = log_sets[:-1], log_sets[1:]
    by_others = [_log_sums_of_products(np.delete(log_ratios, one)) for one in range(len(log_ratios))]
    total = np.logaddexp.reduce
    return log_ratios + [total(sums + log_with) - total(sums + log_without) for sums in by_others]


def _log_sums_of_products(logs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Logs (N + 1,) of the elementary symmetric polynomials: 1, the sum, the sum of products of two, ..."""
    sums = np.zeros(1)
    for one in logs:
        sums = np.logaddexp(np.append(sums, -np.inf), np.append(-np.inf, sums + one))
    return sums
