"""Draws of the posterior of an object in sight, round a pose near the truth: by sequential Monte Carlo.

From a Gaussian in the right tangent at the pose to the posterior, through powers of their ratio, with random
walks at each (Del Moral, Doucet and Jasra 2006).
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

ALIVE = 0.5
"""Effective share of the draws that a step to the next power leaves; the usual choice."""

WALKS, LAST_WALKS = 3, 12
"""At each power, and at the posterior itself, from which draws are taken."""

ACCEPTED = 0.25
"""Share of a random walk's steps that is accepted where it is most efficient (Roberts et al. 1997)."""

LEAST_VARIANCE = 1e-14
"""Added to keep a covariance regular: a tenth of a micrometre."""


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
        poses: (K, 4, 4) world_from_box, draws of the mode.
    """

    log_ratio: float
    poses: NDArray[np.float64]


def seen_posterior(
    rng: np.random.Generator,
    one: SceneObject,
    start: NDArray[np.float64],
    prior: EulerUniformPoses,
    images: RatioOfPoses,
    *,
    draws: int = 512,
    keep: int = 64,
) -> SeenPosterior:
    """The mode that holds a pose.

    Args:
        rng: random numbers.
        one: the object.
        start: (4, 4) world_from_box.
        prior: of its poses.
        images: what was seen.
        draws: that are walked.
        keep: K, at most as many.
    """
    target = _Target(one=one, start=start, prior=prior, images=images)
    steps = FIRST_SIGMA * rng.standard_normal((draws, 6))
    log_ratios = target.log_ratios(steps)
    power, log_mean, scale = 0.0, 0.0, 2.38 / np.sqrt(6)  # Roberts et al. 1997, of the deviation
    while power < 1:
        following = _next_power(log_ratios, power)
        log_weights = (following - power) * log_ratios
        log_mean += np.logaddexp.reduce(log_weights) - np.log(draws)
        weights = np.exp(log_weights - log_weights.max())
        chosen = rng.choice(draws, draws, p=weights / weights.sum())
        steps, log_ratios, power = steps[chosen], log_ratios[chosen], following
        for _ in range(WALKS if power < 1 else LAST_WALKS):
            accepted = _walk(rng, target, steps, log_ratios, power, scale)
            scale *= np.exp(accepted - ACCEPTED)
    kept = rng.choice(draws, keep, replace=False)
    return SeenPosterior(log_ratio=float(log_mean), poses=start @ motions_of(steps[kept]))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Target:
    """Prior times likelihood in the tangent at a pose; attributes as the arguments of `seen_posterior`."""

    one: SceneObject
    start: NDArray[np.float64]
    prior: EulerUniformPoses
    images: RatioOfPoses

    def log_ratios(self, steps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log (n,) of the target over the first Gaussian at steps (n, 6).

        To first order in the small rotations of a mode: the Haar measure of mass pi^2 is an eighth of
        Lebesgue on rotation vectors near zero, and the screws that `motions_of` makes move volumes by the
        second order alone.
        """
        poses = self.start @ motions_of(steps)
        log_target = self.images.log_ratios(self.one, poses) + self.prior.log_density(poses) - np.log(8.0)
        return log_target - _log_first(steps)


def _log_first(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log density (n,) of the first Gaussian at steps (n, 6), Lebesgue."""
    normals = steps / FIRST_SIGMA
    return -0.5 * (normals**2).sum(axis=1) - 3 * np.log(2 * np.pi) - np.log(FIRST_SIGMA).sum()


def _next_power(log_ratios: NDArray[np.float64], power: float) -> float:
    """The greatest power up to 1 that leaves `ALIVE` of the draws that are possible; by bisection."""
    possible = log_ratios[np.isfinite(log_ratios)]

    def alive(following: float) -> bool:
        weights = np.exp((following - power) * (possible - possible.max()))
        return weights.sum() ** 2 >= ALIVE * len(weights) * (weights**2).sum()

    low, high = power, 1.0
    if alive(high):
        return high
    while high - low > 1e-3 * (high - power):
        middle = (low + high) / 2
        low, high = (middle, high) if alive(middle) else (low, middle)
    return low


def _walk(
    rng: np.random.Generator,
    target: _Target,
    steps: NDArray[np.float64],
    log_ratios: NDArray[np.float64],
    power: float,
    scale: float,
) -> float:
    """A random walk's step of every draw, in place; the share that is accepted.

    Sizes are log-normal about `scale` times the draws' deviations: posteriors of pixels have ridges.
    """
    spread = np.linalg.cholesky(np.cov(steps.T) + LEAST_VARIANCE * np.eye(6))
    sizes = scale * rng.lognormal(size=(len(steps), 1))
    moved = steps + sizes * (rng.standard_normal(steps.shape) @ spread.T)
    moved_ratios = target.log_ratios(moved)
    log_accept = _log_first(moved) - _log_first(steps) + power * (moved_ratios - log_ratios)
    accepted = np.log(rng.uniform(size=len(steps))) < log_accept
    steps[accepted], log_ratios[accepted] = moved[accepted], moved_ratios[accepted]
    return float(accepted.mean())
