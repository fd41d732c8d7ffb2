"""Candidate maps from one repeated step: the constant-velocity path of a turntable or an orbit.

Neighbouring views of few on a circle share little, while all views together determine the step well. The few
coordinates of the step are enumerated over the whole circle, coarse to fine, and each is scored as a whole
map: every image against the map of all others.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.stats import norm, qmc

from shapes.geometry import pose_sets
from slam.map_hypotheses.cross_registration import KeyframeRegistrar
from slam.registration import pose_grids
from slam.registration.search import CLIMBED_BLUR, WIDE_ANGLE_RAD, WIDE_BLUR, WIDE_SHIFT_M

JUDGING = 5
"""Images that a step is judged by."""

STARTS, STEPS = 160, 40
"""Distinct ones whose refinement is begun and of which it is ended: the true step was up to the seventieth of
the grid, and among the first five of the refined (circles of 5 in bare rooms; docs/model.md,
development films)."""

REFINING = tuple(0.05 * 0.75**round_ for round_ in range(12))
"""Widths of clouds round each, metres and radians."""

LOG_CLOUD = 6
"""Spacing of the sampled cloud: search effort."""


def circular_steps(registrar: KeyframeRegistrar, distances_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Steps last_from_next (S, 4, 4) of one repeated motion, those that explain the keyframes best first.

    Args:
        registrar: the keyframes, at even times.
        distances_m: (D,) to the pivots of circles that are tried.
    """
    candidates = pose_grids.orbit_steps(distances_m)
    ranked = candidates[np.argsort(-_scores(registrar, candidates, WIDE_BLUR), kind="stable")]
    return _refined(registrar, _first_distinct(ranked, STARTS))


def repeat_step(step: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Poses (..., N, 4, 4) that a step (..., 4, 4) leads through, from the identity."""
    return np.stack([np.linalg.matrix_power(step, index) for index in range(count)], axis=-3)


def _scores(registrar: KeyframeRegistrar, steps: NDArray[np.float64], blur: float) -> NDArray[np.float64]:
    """Sums (C,) over the judging images of their approximate log densities in the map of all others."""
    count = len(registrar)
    return registrar.log_scores(repeat_step(steps, count), range(0, count, -(-count // JUDGING)), blur)


def _first_distinct(steps: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    return steps[pose_sets.suppress_similar(steps, count, WIDE_SHIFT_M, WIDE_ANGLE_RAD)]


def _refined(registrar: KeyframeRegistrar, steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """The best steps near each (S, 4, 4), in clouds that grow narrower and fewer: distinct, best first."""
    for width in REFINING:
        clouds = steps[:, None] @ np.asarray(expm(width * _cloud()))
        scores = _scores(registrar, clouds.reshape(-1, 4, 4), max(width, CLIMBED_BLUR))
        scores = scores.reshape(len(steps), -1)
        best = clouds[np.arange(len(steps)), scores.argmax(axis=1)]
        ranked = best[np.argsort(-scores.max(axis=1), kind="stable")]
        steps = _first_distinct(ranked, max(STEPS, len(steps) // 2))
    return steps


@cache
def _cloud() -> NDArray[np.float64]:
    """Twists (2^n, 4, 4), the first zero, the others evenly spread like a standard Normal."""
    twists = np.zeros((2**LOG_CLOUD, 4, 4))
    even = qmc.Sobol(6, scramble=False).random_base2(LOG_CLOUD)
    for twist, (x, y, z, a, b, c) in zip(twists[1:], norm.ppf(even[1:]), strict=True):
        twist[:3] = [[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z]]
    return twists
