"""Gaussians over camera poses, in one chart and one base measure.

The chart at a centre c is the right tangent with translation first: a pose x has coordinates
xi = (R_c^T (t - t_c), Log(R_c^T R)), metres and radians in the camera's own axes. The base measure is
Lebesgue on translations times the Haar measure of mass pi^2 on rotations (docs/model.md, section O), so that
components with different centres can be added: density = N(xi) 8 / (sin(a/2) / (a/2))^2, a = |Log|.
Poses are wxyz_xyz (7,).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie

LOG_8 = 2.0794415416798357
"""log 8."""


def displace(centre: jax.Array, xi: jax.Array) -> jax.Array:
    """The pose (7,) with coordinates `xi` (6,) in the chart at `centre` (7,)."""
    pose = jaxlie.SE3(centre)
    rotation = pose.rotation()
    return jaxlie.SE3.from_rotation_and_translation(
        (rotation @ jaxlie.SO3.exp(xi[3:])).normalize(), pose.translation() + rotation @ xi[:3]
    ).wxyz_xyz


def coordinates(centre: jax.Array, pose: jax.Array) -> jax.Array:
    """Coordinates (6,) of `pose` (7,) in the chart at `centre` (7,)."""
    origin, target = jaxlie.SE3(centre), jaxlie.SE3(pose)
    inverse = origin.rotation().inverse()
    return jnp.concatenate(
        [inverse @ (target.translation() - origin.translation()), (inverse @ target.rotation()).log()]
    )


@jax.jit
def carried_along(relative: jax.Array) -> jax.Array:
    """A displacement of an origin as one (6, 6) of what stands fixed beside it at origin_from_pose (7,).

    Each in its own chart: with rotation R and translation t, R^T (xi_t + xi_r x t) and R^T xi_r.
    """
    return jaxlie.SE3(relative).inverse().adjoint()


def log_chart_factor(rotation_vector: jax.Array) -> jax.Array:
    """Log of 8 / (sin(a/2) / (a/2))^2, which turns densities of (3,) rotation vectors into Haar ones."""
    half_squared = 0.25 * (rotation_vector**2).sum()
    small = half_squared < 1e-4
    half = jnp.sqrt(jnp.where(small, 1.0, half_squared))
    log_sinc = jnp.where(small, -half_squared / 6.0, jnp.log(jnp.abs(jnp.sin(half)) / half))
    return LOG_8 - 2.0 * log_sinc


def log_density(pose: jax.Array, centre: jax.Array, scale: jax.Array) -> jax.Array:
    """Log density of a Gaussian at `centre` with covariance scale scale^T, in the base measure.

    Args:
        pose: (7,).
        centre: (7,).
        scale: (6, 6) lower triangular.
    """
    xi = coordinates(centre, pose)
    whitened = jax.scipy.linalg.solve_triangular(scale, xi, lower=True)
    log_determinant = jnp.log(jnp.diagonal(scale)).sum()
    log_normal = -0.5 * (whitened**2).sum() - log_determinant - 3.0 * jnp.log(2.0 * jnp.pi)
    return log_normal + log_chart_factor(xi[3:])


def sample(key: jax.Array, centre: jax.Array, scale: jax.Array) -> jax.Array:
    """Draw of a pose (7,) from the Gaussian at `centre` (7,) with covariance scale scale^T."""
    return displace(centre, scale @ jax.random.normal(key, (6,), scale.dtype))
