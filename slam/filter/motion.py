"""Motion priors p(x_t | past): a free hand, and an orbit that keeps its distance from an object.

Every density is in the base measure of `shapes.geometry.pose_gaussian`; every prior samples in its own
coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from shapes.geometry import pose_gaussian
from shapes.geometry.rotation_densities import (
    LOG_ROTATION_MASS,
    von_mises_fisher,
    von_mises_fisher_direction,
)
from shapes.stored_kernels import jit_stored


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MotionHistory:
    """What of one hypothesis' past its motion prior looks at.

    Attributes:
        pose: (7,) reference_from_camera of the last frame.
        predicted: (7,) where constant velocity leads, the gap in time taken into account.
        pivot: (3,) the point that an orbit looks at, in the reference frame, metres.
    """

    pose: jax.Array
    predicted: jax.Array
    pivot: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FreeMotion:
    """Six degrees of freedom: mostly constant velocity, sometimes a jerk, rarely anything.

    A mixture of three: a Gaussian at the predicted pose, a wide Gaussian at the last one, and rotations
    uniform with translations Gaussian.
    """

    log_shares: jax.Array
    steady_scale: jax.Array
    jerk_scale: jax.Array
    jump_sigma_m: jax.Array

    @classmethod
    def default(cls) -> FreeMotion:
        """Sized for hand-held cameras at 3 to 30 frames a second, with jumps of over a metre possible."""
        return cls(
            log_shares=jnp.log(jnp.asarray([0.6, 0.3, 0.1], jnp.float32)),
            steady_scale=jnp.diag(jnp.asarray([0.02] * 3 + [0.02] * 3, jnp.float32)),
            jerk_scale=jnp.diag(jnp.asarray([0.15] * 3 + [0.15] * 3, jnp.float32)),
            jump_sigma_m=jnp.asarray(0.8, jnp.float32),
        )

    def sample(self, key: jax.Array, history: MotionHistory) -> jax.Array:
        """A pose (7,)."""
        kind_key, steady_key, jerk_key, rotation_key, translation_key = jax.random.split(key, 5)
        steady = pose_gaussian.sample(steady_key, history.predicted, self.steady_scale)
        jerk = pose_gaussian.sample(jerk_key, history.pose, self.jerk_scale)
        shift = self.jump_sigma_m * jax.random.normal(translation_key, (3,), jnp.float32)
        jump = jaxlie.SE3.from_rotation_and_translation(
            jaxlie.SO3.sample_uniform(rotation_key), jaxlie.SE3(history.pose).translation() + shift
        ).wxyz_xyz
        kind = jax.random.categorical(kind_key, self.log_shares)
        return jnp.stack([steady, jerk, jump])[kind]

    def log_density(self, history: MotionHistory, pose: jax.Array) -> jax.Array:
        """Log density of a pose (7,)."""
        return jax.nn.logsumexp(self._log_parts(history, pose))

    def _log_parts(self, history: MotionHistory, pose: jax.Array) -> jax.Array:
        """Log densities (3,) of the components, their shares included."""
        shift = (pose[4:] - history.pose[4:]) / self.jump_sigma_m
        log_jump = (
            -0.5 * (shift**2).sum()
            - 3.0 * (jnp.log(self.jump_sigma_m) + 0.5 * jnp.log(2.0 * jnp.pi))
            - LOG_ROTATION_MASS
        )
        steady = pose_gaussian.log_density(pose, history.predicted, self.steady_scale)
        jerk = pose_gaussian.log_density(pose, history.pose, self.jerk_scale)
        return self.log_shares + jnp.stack([steady, jerk, log_jump])

    def whitened_residual(self, history: MotionHistory, pose: jax.Array) -> jax.Array:
        """Residuals (n,) whose half sum of squares bends like -log density in its bulk (Gauss-Newton).

        The jerk component's: wide enough to pull nowhere, enough to hold what no pixel sees.
        """
        return jax.scipy.linalg.solve_triangular(
            self.jerk_scale, pose_gaussian.coordinates(history.pose, pose), lower=True
        )

    def expected_residual(self, history: MotionHistory, pose: jax.Array) -> jax.Array:
        """Residuals (n,) whose half sum of squares falls and bends like -log density at the pose itself.

        All components', each by the root of the probability that the pose is from it (EM's bound).
        """
        probable = jax.lax.stop_gradient(jax.nn.softmax(self._log_parts(history, pose)))
        residuals = [
            jax.scipy.linalg.solve_triangular(scale, pose_gaussian.coordinates(centre, pose), lower=True)
            for centre, scale in (
                (history.predicted, self.steady_scale),
                (history.pose, self.jerk_scale),
            )
        ]
        residuals.append((pose[4:] - history.pose[4:]) / self.jump_sigma_m)
        return jnp.concatenate(
            [jnp.sqrt(share) * each for share, each in zip(probable, residuals, strict=True)]
        )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OrbitMotion:
    """A camera that keeps its distance from a pivot and looks at it; steps as wide as the whole sphere.

    Coordinates: distance to the pivot (Gaussian at the first frame's distance), direction from the pivot
    (half uniform on the sphere, half von Mises-Fisher at the last direction), and a rotation vector
    (Gaussian) away from the last orientation carried along the great circle and turned to the pivot.
    """

    distance_sigma_m: jax.Array
    concentration: jax.Array
    aim_scale_rad: jax.Array

    @classmethod
    def default(cls) -> OrbitMotion:
        """Distances to 3 mm, aim to 1.5 degrees, roll about the optical axis to 20 degrees."""
        return cls(
            distance_sigma_m=jnp.asarray(0.003, jnp.float32),
            concentration=jnp.asarray(30.0, jnp.float32),
            aim_scale_rad=jnp.asarray([0.025, 0.025, 0.35], jnp.float32),
        )

    @classmethod
    def of_unknown_radius(cls, distance_sigma_m: float) -> OrbitMotion:
        """The same where the pivot itself is only known to `distance_sigma_m`."""
        return replace(cls.default(), distance_sigma_m=jnp.asarray(distance_sigma_m, jnp.float32))

    def sample(self, key: jax.Array, history: MotionHistory) -> jax.Array:
        """A pose (7,)."""
        distance_key, kind_key, uniform_key, near_key, aim_key = jax.random.split(key, 5)
        last_direction, _ = _direction_and_distance(history.pose[4:], history.pivot)
        distance = jnp.linalg.norm(history.pivot) + self.distance_sigma_m * jax.random.normal(distance_key)
        anywhere = jax.random.normal(uniform_key, (3,), jnp.float32)
        anywhere = anywhere / jnp.linalg.norm(anywhere)
        uniforms = jax.vmap(jax.random.uniform)(jax.random.split(near_key))
        north = jnp.asarray([0.0, 0.0, 1.0], jnp.float32)
        near = von_mises_fisher_direction(self.concentration, uniforms)
        near = _rotation_between(north, last_direction) @ near
        direction = jnp.where(jax.random.bernoulli(kind_key), anywhere, near)
        aim = self.aim_scale_rad * jax.random.normal(aim_key, (3,), jnp.float32)
        rotation = _carried_rotation(history, direction) @ jaxlie.SO3.exp(aim)
        position = history.pivot + distance * direction
        return jaxlie.SE3.from_rotation_and_translation(rotation.normalize(), position).wxyz_xyz

    def log_density(self, history: MotionHistory, pose: jax.Array) -> jax.Array:
        """Log density of a pose (7,)."""
        direction, distance = _direction_and_distance(pose[4:], history.pivot)
        last_direction, _ = _direction_and_distance(history.pose[4:], history.pivot)
        excess = (distance - jnp.linalg.norm(history.pivot)) / self.distance_sigma_m
        log_distance = -0.5 * excess**2 - jnp.log(self.distance_sigma_m) - 0.5 * jnp.log(2.0 * jnp.pi)
        near = von_mises_fisher(self.concentration, direction @ last_direction)
        log_direction = jnp.log(0.5 * near + 0.5 / (4.0 * jnp.pi))
        aim = (_carried_rotation(history, direction).inverse() @ jaxlie.SE3(pose).rotation()).log()
        whitened = aim / self.aim_scale_rad
        log_aim = (
            -0.5 * (whitened**2).sum()
            - jnp.log(self.aim_scale_rad).sum()
            - 1.5 * jnp.log(2.0 * jnp.pi)
            + pose_gaussian.log_chart_factor(aim)
        )
        return log_distance - 2.0 * jnp.log(distance) + log_direction + log_aim

    def whitened_residual(self, history: MotionHistory, pose: jax.Array) -> jax.Array:
        """Distance and aim; the direction is free."""
        direction, distance = _direction_and_distance(pose[4:], history.pivot)
        excess = (distance - jnp.linalg.norm(history.pivot)) / self.distance_sigma_m
        aim = (_carried_rotation(history, direction).inverse() @ jaxlie.SE3(pose).rotation()).log()
        return jnp.concatenate([excess[None], aim / self.aim_scale_rad])

    def expected_residual(self, history: MotionHistory, pose: jax.Array) -> jax.Array:
        """The same: by far the most of it."""
        return self.whitened_residual(history, pose)


MotionPrior = FreeMotion | OrbitMotion
"""p(x_t | past) of one hypothesis."""


def _direction_and_distance(position: jax.Array, pivot: jax.Array) -> tuple[jax.Array, jax.Array]:
    offset = position - pivot
    distance = jnp.linalg.norm(offset)
    return offset / distance, distance


def _rotation_between(source: jax.Array, target: jax.Array) -> jaxlie.SO3:
    """The least rotation that turns unit vector `source` (3,) to `target` (3,)."""
    wxyz = jnp.concatenate([(1.0 + source @ target)[None], jnp.cross(source, target)])
    half_turn = jnp.linalg.norm(wxyz) < 1e-6
    wxyz = jnp.where(half_turn, jnp.asarray([0.0, 1.0, 0.0, 0.0], wxyz.dtype), wxyz)
    return jaxlie.SO3(wxyz).normalize()


def _carried_rotation(history: MotionHistory, direction: jax.Array) -> jaxlie.SO3:
    """The last orientation carried along the great circle to `direction` and turned to face the pivot."""
    last_direction, _ = _direction_and_distance(history.pose[4:], history.pivot)
    carried = _rotation_between(last_direction, direction) @ jaxlie.SE3(history.pose).rotation()
    optical_axis = carried @ jnp.asarray([0.0, 0.0, 1.0], direction.dtype)
    return _rotation_between(optical_axis, -direction) @ carried


WIDE_STEP = 3.55
"""Standard deviations that hold 95% of jerks: the root of the chi-square's quantile for six coordinates."""


def is_wide_step(before: NDArray[np.float32], after: NDArray[np.float32]) -> bool:
    """Whether a camera does not move so far, from a pose (7,) to another, but by a jump.

    It may have gone to a place that only looks like where it was found: from one corner of a room to another.
    """
    at_rest = MotionHistory(jnp.asarray(before), jnp.asarray(before), jnp.zeros(3))
    residual = FreeMotion.default().whitened_residual(at_rest, jnp.asarray(after))
    return float(jnp.linalg.norm(residual)) > WIDE_STEP


SAMPLED_STEPS = 1024
"""From which a moment is taken, good to a twentieth."""


@jit_stored()
def spread_of_a_step(motion: MotionPrior, pose: jax.Array, pivot: jax.Array) -> jax.Array:
    """Second moment (6, 6) of a step from rest at a pose (7,), in the chart there."""

    def drawn(key: jax.Array) -> jax.Array:
        return pose_gaussian.coordinates(pose, motion.sample(key, MotionHistory(pose, pose, pivot)))

    steps = jax.vmap(drawn)(jax.random.split(jax.random.key(0), SAMPLED_STEPS))
    return steps.T @ steps / SAMPLED_STEPS


LONGEST_RATIO = 3.0
"""Intervals over which a velocity is continued; beyond, the motion is unknown. Chosen by hand; gaps in
recordings."""


def velocity_ratio(times_ns: tuple[int, int], time_ns: int) -> float:
    """The coming interval in units of the last one; zero where there is none, at most `LONGEST_RATIO`."""
    last = times_ns[1] - times_ns[0]
    return float(np.clip((time_ns - times_ns[1]) / last, 0.0, LONGEST_RATIO)) if last > 0 else 0.0
