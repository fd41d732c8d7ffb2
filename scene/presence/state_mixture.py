"""Mixtures of Gaussians on poses and sizes of objects, from which candidates are drawn.

A state (10,) is world_from_box (7,) and the logs of the box's half sizes. Steps (9,) from one to another are
the offset in the world of a point of the object, a turn on the right, and changes of the logs of sizes. The
point is on the line about which the object is round, where there is one, so that it stays as that spins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from scene.presence.size_prior import free_sizes
from shapes.geometry.rotation_densities import LOG_CONTACT_JACOBIAN

SMALL_RAD = 1e-6
"""Below it sin(t / 2) / (t / 2) is 1 to rounding."""


@dataclass(frozen=True, kw_only=True, eq=False)
class StateMixture:
    """C components for each of N objects, in the measure Lebesgue x rotations of mass pi^2 x Lebesgue.

    Attributes:
        log_weights: (N, C), normalised; -inf for places without use.
        centres: (N, C, 10) states.
        factors: (N, C, 9, 9) lower factors of the covariances of steps; of sizes that are not free identity.
        points_m: (N, 3) in the boxes.
        ties: (N, 3) for each axis of the box the first one whose size it follows.
    """

    log_weights: NDArray[np.float64]
    centres: NDArray[np.float64]
    factors: NDArray[np.float64]
    points_m: NDArray[np.float64]
    ties: NDArray[np.intp]

    def only(self, objects: NDArray[np.bool_]) -> StateMixture:
        """That of some of the objects (N,)."""
        return StateMixture(**{name: part[objects] for name, part in vars(self).items()})

    def drawn(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """States (N, count, 10)."""
        ends = np.exp(self.log_weights).cumsum(axis=1)
        uniform = rng.random((len(ends), count, 1)) * ends[:, None, -1:]
        chosen = np.minimum((uniform >= ends[:, None]).sum(axis=2), ends.shape[1] - 1)
        objects = np.arange(len(ends))[:, None]
        normal = rng.standard_normal((*chosen.shape, 9))
        steps = np.einsum("nkij,nkj->nki", self.factors[objects, chosen], normal)
        return _stepped(self.centres[objects, chosen], steps, self.points_m[:, None], self.ties[:, None])

    def log_density(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density (N, K) of states (N, K, 10), summed over components."""
        steps = _steps_between(self.centres[:, None], states[:, :, None], self.points_m[:, None, None])
        free = np.concatenate([np.ones((len(states), 6), bool), free_sizes(self.ties)], axis=1)
        steps = np.where(free[:, None, None], steps, 0.0)
        white = np.linalg.solve(self.factors[:, None], steps[..., None])[..., 0]
        log_normal = -0.5 * (white**2).sum(axis=-1)
        log_normal -= np.log(np.diagonal(self.factors, axis1=2, axis2=3)).sum(axis=-1)[:, None]
        log_normal -= 0.5 * math.log(2 * math.pi) * free.sum(axis=1)[:, None, None]
        half = 0.5 * np.linalg.norm(steps[..., 3:6], axis=-1)
        stretch = np.where(half > SMALL_RAD, np.sin(half) / np.maximum(half, SMALL_RAD), 1.0)
        log_normal += LOG_CONTACT_JACOBIAN - 2 * np.log(np.maximum(stretch, SMALL_RAD))
        return np.asarray(logsumexp(self.log_weights[:, None] + log_normal, axis=2))


def _stepped(
    centres: NDArray[np.float64],
    steps: NDArray[np.float64],
    points_m: NDArray[np.float64],
    ties: NDArray[np.intp],
) -> NDArray[np.float64]:
    """States (..., 10) after steps (..., 9) from centres (..., 10)."""
    before = _rotations(centres)
    after = before * Rotation.from_rotvec(steps[..., 3:6].reshape(-1, 3))
    points = np.array(np.broadcast_to(points_m, (*steps.shape[:-1], 3))).reshape(-1, 3)
    moved = (before.apply(points) - after.apply(points)).reshape(*steps.shape[:-1], 3)
    sizes = np.take_along_axis(steps[..., 6:], np.broadcast_to(ties, (*steps.shape[:-1], 3)), axis=-1)
    wxyz = after.as_quat(scalar_first=True).reshape(*steps.shape[:-1], 4)
    places = centres[..., 4:7] + steps[..., :3] + moved
    return np.concatenate([wxyz, places, centres[..., 7:] + sizes], axis=-1)


def _steps_between(
    centres: NDArray[np.float64], states: NDArray[np.float64], points_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Steps (..., 9) from centres (..., 10) to states (..., 10)."""
    centres, states = np.broadcast_arrays(centres, states)
    before, after = _rotations(centres), _rotations(states)
    points = np.array(np.broadcast_to(points_m, (*states.shape[:-1], 3))).reshape(-1, 3)
    moved = (after.apply(points) - before.apply(points)).reshape(*states.shape[:-1], 3)
    turns = (before.inv() * after).as_rotvec().reshape(*states.shape[:-1], 3)
    offset = states[..., 4:] - centres[..., 4:]
    return np.concatenate([offset[..., :3] + moved, turns, offset[..., 3:]], axis=-1)


def _rotations(states: NDArray[np.float64]) -> Rotation:
    return Rotation.from_quat(states[..., :4].reshape(-1, 4), scalar_first=True)
