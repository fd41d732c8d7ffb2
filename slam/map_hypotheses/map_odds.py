"""Odds of whole maps from the composite likelihood of all images, calibrated by its own variance.

A composite likelihood overstates: neighbouring pixels err alike, and where maps are wrong at creases or
sensors bend planes they do so in every map. By how much, the blocks of pixels tell themselves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def log_odds(log_composites: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log odds (M,), none above 0, of maps against the one that all images agree with most.

    The sum D of the differences between two maps has a variance of about V, the sum of their squares over
    blocks that are independent (Vuong 1989, for models that are wrong). A log ratio that is right has, where
    the one map is true, half its variance as its mean; so has 2 D / V times D.

    Args:
        log_composites: (M, B) nats of each map, by blocks of pixels; a map with one that is no number, or not
            finite, has no odds.
    """
    log_totals = log_composites.sum(axis=1)
    known = np.isfinite(log_totals)
    odds = np.full(len(log_totals), -np.inf)
    if known.any():
        best = log_composites[np.argmax(np.where(known, log_totals, -np.inf))]
        differences = log_composites[known] - best
        variances = (differences**2).sum(axis=1)
        odds[known] = -2 * differences.sum(axis=1) ** 2 / np.where(variances > 0, variances, 1.0)
    return odds
