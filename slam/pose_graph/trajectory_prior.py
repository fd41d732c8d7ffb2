"""The motion prior of whole maps: log p of every keyframe pose given those before it, and its curvature.

The pivot of an orbit is as uncertain as the first camera's aim at it. It is integrated out by Laplace's
approximation at the most probable pivot of each map.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from shapes.geometry import pose_gaussian
from shapes.geometry.poses import poses_of
from slam.config import SlamConfig
from slam.filter.motion import FreeMotion, MotionHistory, MotionPrior, OrbitMotion, velocity_ratio
from slam.filter.state import FilterState
from slam.pose_graph.displacements import in_parts
from slam.pose_graph.sparse_gaussian import JointTerm

PIVOT_STEPS = 6
"""Newton's, to the likeliest pivot."""

POSE, PIVOT = 6, 3
"""Dimensions of a pose and of a pivot."""


@dataclass(frozen=True)
class TrajectoryPrior:
    """The prior and what it looks at besides poses.

    Attributes:
        motion: p(x_t | past).
        pivot_m: (3,) mean of what an orbit looks at, in the first keyframe.
        pivot_sigma_m: (3,) its standard deviations.
        times_ns: (N,) of the keyframes.
    """

    motion: MotionPrior
    pivot_m: NDArray[np.float64]
    pivot_sigma_m: NDArray[np.float64]
    times_ns: tuple[int, ...]

    @classmethod
    def of(cls, state: FilterState, config: SlamConfig) -> TrajectoryPrior:
        """As the filter has it; free where the radius of an orbit is a guess, for it may be off by half."""
        motion = state.motion if config.orbit_radius_m else FreeMotion.default()
        pivot, sigma = state.pivot.astype(np.float64), np.ones(PIVOT)
        if isinstance(motion, OrbitMotion):
            aim = np.asarray(motion.aim_scale_rad, np.float64)[:2]
            sigma = np.append(pivot[2] * aim, float(motion.distance_sigma_m))
        return cls(motion, pivot, sigma, state.keyframe_times_ns)

    def log_density(self, poses: NDArray[np.float64]) -> float:
        """sum_t log p(x_t | x_t-1, x_t-2) of poses (N, 4, 4), in the base measure of pose_gaussian.

        Frames between keyframes are as if there were none: the prior's steps are as long as any.
        """
        return self._expanded(poses)[0]

    def bent(self, poses: NDArray[np.float64]) -> JointTerm:
        """Gradient of minus the log density at poses (N, 4, 4), and its curvature by Gauss-Newton."""
        return self._expanded(poses)[1]

    def _expanded(self, poses: NDArray[np.float64]) -> tuple[float, JointTerm]:
        size = POSE * len(poses)
        pivot = self._pivot_of(poses)
        value, gradient, curvature = self._at(poses, pivot)
        for _ in range(PIVOT_STEPS):
            trial = pivot - np.linalg.solve(curvature[size:, size:], gradient[size:])
            found = self._at(poses, trial)
            if not found[0] < value:
                break
            pivot, (value, gradient, curvature) = trial, found
        own, across = curvature[size:, size:], curvature[:size, size:]
        reduced = np.linalg.solve(own, np.column_stack([across.T, gradient[size:]]))
        laplace = 0.5 * (PIVOT * np.log(2.0 * np.pi) - np.linalg.slogdet(own)[1])
        term = JointTerm(
            precision=curvature[:size, :size] - across @ reduced[:, :-1],
            gradient=gradient[:size] - across @ reduced[:, -1],
        )
        return laplace - value, term

    def _pivot_of(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """About the likeliest pivot (3,): all cameras are as far from it as the first, |c|^2 = 2 c . p."""
        if not isinstance(self.motion, OrbitMotion):
            return self.pivot_m
        places = poses[:, :3, 3]
        sigma = float(self.motion.distance_sigma_m) * np.linalg.norm(self.pivot_m)
        rows = np.concatenate([places / sigma, np.diag(1.0 / self.pivot_sigma_m)])
        sides = np.append(0.5 * (places**2).sum(axis=1) / sigma, self.pivot_m / self.pivot_sigma_m)
        return np.linalg.lstsq(rows, sides, rcond=None)[0].astype(np.float64)

    def _at(
        self, poses: NDArray[np.float64], pivot: NDArray[np.float64]
    ) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
        """Minus log p(poses, pivot), gradient (6 N + 3,) and curvature in displacements and the pivot."""
        count = len(poses)
        placed, trio = poses_of(poses), np.maximum(np.arange(count)[:, None] - np.asarray([2, 1, 0]), 0)
        ratios = np.zeros(count, np.float32)
        for at in range(2, count):
            first, second, third = self.times_ns[at - 2 : at + 1]
            ratios[at] = velocity_ratio((first, second), third)
        terms = in_parts(partial(_terms, self.motion, jnp.asarray(pivot, jnp.float32)), placed[trio], ratios)
        log_densities, residuals, jacobians = (leaf[1:].astype(np.float64) for leaf in terms)
        excess = (pivot - self.pivot_m) / self.pivot_sigma_m
        log_prior = -0.5 * (excess @ excess) - np.log(self.pivot_sigma_m * np.sqrt(2.0 * np.pi)).sum()
        gradient, curvature = np.zeros(POSE * count + PIVOT), np.zeros((POSE * count + PIVOT,) * 2)
        gradient[-PIVOT:] = excess / self.pivot_sigma_m
        curvature[-PIVOT:, -PIVOT:] = np.diag(self.pivot_sigma_m**-2.0)
        for trio_of, residual, jacobian in zip(trio[1:count], residuals, jacobians, strict=True):
            own = np.append(
                (trio_of[:, None] * POSE + np.arange(POSE)).ravel(), POSE * count + np.arange(PIVOT)
            )
            np.add.at(gradient, own, residual @ jacobian)
            np.add.at(curvature, np.ix_(own, own), jacobian.T @ jacobian)
        return float(-log_densities.sum() - log_prior), gradient, curvature


@jax.jit
def _terms(
    motion: MotionPrior, pivot: jax.Array, trios: jax.Array, ratios: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log p (N,), residuals (N, n) and their Jacobians (N, n, 21) of poses that follow two others (N, 3, 7).

    Intervals are in the given ratios (N,). Coordinates are displacements of the three and of the pivot.
    """

    def at(trio: jax.Array, ratio: jax.Array, coordinates: jax.Array) -> tuple[MotionHistory, jax.Array]:
        moved = jax.vmap(pose_gaussian.displace)(trio, coordinates[:-PIVOT].reshape(3, POSE))
        predicted = pose_gaussian.displace(moved[1], ratio * pose_gaussian.coordinates(moved[0], moved[1]))
        return MotionHistory(moved[1], predicted, pivot + coordinates[-PIVOT:]), moved[2]

    def one(trio: jax.Array, ratio: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        def residual(coordinates: jax.Array) -> tuple[jax.Array, jax.Array]:
            of_pose = motion.expected_residual(*at(trio, ratio, coordinates))
            return of_pose, of_pose

        origin = jnp.zeros(3 * POSE + PIVOT, jnp.float32)
        jacobian, here = jax.jacfwd(residual, has_aux=True)(origin)
        return motion.log_density(*at(trio, ratio, origin)), here, jacobian

    return jax.vmap(one)(trios, ratios)
