"""Draws of the posterior of an object in sight, round a pose near the truth: by population Monte Carlo.

A Gaussian in the right tangent at a pose is fitted to weighted draws of itself, over and over (Cappé et al.
2004), the weights raised to a power that leaves some of them alive.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scene.hidden.pose_priors import EulerUniformPoses
from scene.objects.scene_object import SceneObject
from shapes.geometry.poses import motions_of

FIRST_SIGMA = np.array([0.002] * 3 + [0.01] * 3)
"""Metres and radians round the start, some times what a depth image leaves open."""

ALIVE = 0.1
"""Least effective share of the draws that the power leaves."""

LEAST_VARIANCE = 1e-14
"""Added to keep a covariance regular: a tenth of a micrometre."""

WIDER = 1.5
"""By which fitted deviations are widened, so that the proposal has the heavier tails."""


class RatioOfPoses(Protocol):
    """What `DepthImages` says of an object."""

    def log_ratios(self, one: SceneObject, world_from_box: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log likelihood ratio (n,) of each pose (n, 4, 4) against the object's absence."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class SeenPosterior:
    """One mode of an object's posterior.

    Attributes:
        log_ratio: log of the mean likelihood ratio over its prior poses, this mode's share alone.
        effective_draws: of the last round.
        poses: (K, 4, 4) world_from_box, draws of the mode.
    """

    log_ratio: float
    effective_draws: float
    poses: NDArray[np.float64]


def seen_posterior(
    rng: np.random.Generator,
    one: SceneObject,
    start: NDArray[np.float64],
    prior: EulerUniformPoses,
    images: RatioOfPoses,
    *,
    draws: int = 1024,
    rounds: int = 8,
    keep: int = 16,
) -> SeenPosterior:
    """The mode that holds a pose.

    Args:
        rng: random numbers.
        one: the object.
        start: (4, 4) world_from_box.
        prior: of its poses.
        images: what was seen.
        draws: of a round.
        rounds: of fitting, after the first.
        keep: K.
    """
    centre, scale = start, np.diag(FIRST_SIGMA)
    steps, log_weights = _weighed(rng, one, centre, scale, prior, images, draws)
    for _ in range(rounds):
        weights = _alive(log_weights)
        mean = weights @ steps
        spread = (weights[:, None] * (steps - mean)).T @ (steps - mean)
        centre = centre @ motions_of(mean)
        scale = WIDER * np.linalg.cholesky(spread + LEAST_VARIANCE * np.eye(6))
        steps, log_weights = _weighed(rng, one, centre, scale, prior, images, draws)
    log_mean = np.logaddexp.reduce(log_weights) - np.log(draws)
    weights = np.exp(log_weights - log_weights.max())
    return SeenPosterior(
        log_ratio=float(log_mean),
        effective_draws=float(weights.sum() ** 2 / (weights**2).sum()),
        poses=centre @ motions_of(steps[rng.choice(draws, keep, p=weights / weights.sum())]),
    )


def _weighed(
    rng: np.random.Generator,
    one: SceneObject,
    centre: NDArray[np.float64],
    scale: NDArray[np.floating],
    prior: EulerUniformPoses,
    images: RatioOfPoses,
    draws: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Steps (n, 6) from the centre and their log weights (n,), prior times likelihood over proposal.

    To first order in the small rotations of a mode: the Haar measure of mass pi^2 is an eighth of Lebesgue on
    rotation vectors near zero, and the screws that `motions_of` makes move volumes by the second order alone.
    """
    normals = rng.standard_normal((draws, 6))
    steps = normals @ scale.T
    poses = centre @ motions_of(steps)
    log_normal = -0.5 * (normals**2).sum(axis=1) - 3 * np.log(2 * np.pi) - np.log(np.diag(scale)).sum()
    return steps, images.log_ratios(one, poses) + prior.log_density(poses) - log_normal - np.log(8.0)


def _alive(log_weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normalised weights (n,), raised to the greatest power of 2^-k that leaves enough of them alive."""
    power = 1.0
    while True:
        weights = np.exp(power * (log_weights - log_weights.max()))
        if weights.sum() ** 2 / (weights**2).sum() >= ALIVE * len(weights):
            return weights / weights.sum()
        power /= 2
