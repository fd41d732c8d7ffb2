"""Odds of whole maps from the composite likelihood of all images, calibrated by its own variance.

A composite likelihood overstates: neighbouring pixels err alike, and where maps are wrong at creases or
sensors bend planes they do so in every map. By how much, the blocks of pixels tell themselves, and the
images, each of which stands in its place or not as a whole: round a bare corner a wrong map explains all
blocks of an image better.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def log_odds(log_composites: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log odds (M,), none above 0, of maps against the one that all images agree with most.

    The sum D of the differences between two maps has a variance V (Vuong 1989, for models that are wrong):
    that of independent blocks, or of independent images, whichever is larger. A log ratio that is right has,
    where the one map is true, half its variance as its mean; so has 2 D / V times D.

    Args:
        log_composites: (M, N, B) nats of each map, by N images and their blocks of pixels; a map with one
            that is no number, or not finite, has no odds.
    """
    log_totals = log_composites.sum(axis=(1, 2))
    known, images = np.isfinite(log_totals), log_composites.shape[1]
    odds = np.full(len(log_totals), -np.inf)
    if known.any():
        best = log_composites[np.argmax(np.where(known, log_totals, -np.inf))]
        differences = log_composites[known] - best
        of_images = differences.sum(axis=2)
        by_images = images * of_images.var(axis=1, ddof=int(images > 1))
        variances = np.maximum((differences**2).sum(axis=(1, 2)), by_images)
        odds[known] = -2 * of_images.sum(axis=1) ** 2 / np.where(variances > 0, variances, 1.0)
    return odds
