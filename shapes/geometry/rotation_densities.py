"""Densities on rotations and directions in the one base measure of supplement O.

Rotations carry the Haar measure with total mass pi^2 (arc length on unit quaternions up to sign), the
sphere S^2 has mass 4 pi and the circle S^1 2 pi. Quaternions are wxyz.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from shapes.geometry import quaternions

LOG_ROTATION_MASS = 2 * math.log(math.pi)

LOG_CONTACT_JACOBIAN = math.log(8.0)
"""log of d(S^2 x S^1) / d(rotation): 4 pi 2 pi / pi^2 (supplement O.6.4)."""

_WINDINGS = (-1, 0, 1)
"""Terms of the wrapped sum; further ones are negligible at the widths in use."""


def hopf_coordinates(wxyz: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where a rotation carries the north pole, eta (3,), and how much it spins about it, phi in [0, 2 pi)."""
    w, x, y, z = wxyz
    eta = jnp.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    return eta, jnp.mod(2 * jnp.arctan2(z, w), 2 * jnp.pi)


def rotation_from_hopf(eta: jax.Array, phi: jax.Array) -> jax.Array:
    """The rotation, wxyz (4,), with these Hopf coordinates; undefined at the south pole.

    The halves of the angle are missing in the supplement's printed inverse (docs/model.md, section O).
    """
    a, b, c = eta
    cos, sin = jnp.cos(phi / 2), jnp.sin(phi / 2)
    wxyz = jnp.stack([(1 + c) * cos, a * sin - b * cos, a * cos + b * sin, (1 + c) * sin])
    return wxyz / jnp.sqrt(2 * (1 + c))


def von_mises_fisher(concentration: jax.Array, cosine: jax.Array) -> jax.Array:
    """Density on S^2 at an angle of that cosine from the mean direction."""
    normaliser = concentration / (2 * jnp.pi * -jnp.expm1(-2 * concentration))
    return normaliser * jnp.exp(concentration * (cosine - 1))


def von_mises_fisher_direction(concentration: jax.Array, uniforms: jax.Array) -> jax.Array:
    """Direction (3,) about the north pole from two uniform numbers."""
    log_mass = jnp.log(uniforms[0] + (1 - uniforms[0]) * jnp.exp(-2 * concentration))
    return _direction(jnp.clip(1 + log_mass / concentration, -1, 1), uniforms[1])


def hemisphere_direction(uniforms: jax.Array) -> jax.Array:
    """Direction (3,), uniform on the northern hemisphere, from two uniform numbers."""
    return _direction(uniforms[0], uniforms[1])


def uniform_rotation(uniforms: jax.Array) -> jax.Array:
    """Rotation, wxyz (4,), uniform under Haar, from three uniform numbers (Shoemake 1992)."""
    low, high = jnp.sqrt(1 - uniforms[0]), jnp.sqrt(uniforms[0])
    first, second = 2 * jnp.pi * uniforms[1], 2 * jnp.pi * uniforms[2]
    return jnp.stack(
        [high * jnp.cos(second), low * jnp.sin(first), low * jnp.cos(first), high * jnp.sin(second)]
    )


def log_gaussian_pose(whitening: jax.Array, offset_m: jax.Array, wxyz: jax.Array) -> jax.Array:
    """Log density of an offset (3,) and a rotation whose 6-D tangent is Gaussian, mean zero.

    The rotation vector's Normal is wrapped round the group: the density sums over the windings
    |xi| + 2 pi k, each with its Jacobian 8 / (sin(t/2) / (t/2))^2 (docs/model.md, section O). Three windings
    are exact to 1e-9 for standard deviations up to 1 rad.

    Args:
        whitening: (6, 6) inverse of the lower factor of the tangent's covariance, translation first.
        offset_m: (3,).
        wxyz: the rotation relative to the centre.
    """
    xi = quaternions.log(wxyz)
    angle = jnp.sqrt(jnp.sum(xi * xi) + jnp.finfo(xi.dtype).tiny)
    sinc = jnp.where(angle > 1e-6, jnp.sin(angle / 2) / (angle / 2), 1.0)
    stretches = 1 + 2 * jnp.pi * np.array(_WINDINGS, float) / jnp.maximum(angle, 1e-12)
    still, turning = (
        jnp.sum(whitening[:, :3] * offset_m[None], axis=1),
        jnp.sum(whitening[:, 3:] * xi[None], axis=1),
    )
    whitened = still[None] + stretches[:, None] * turning[None]
    log_terms = -0.5 * jnp.sum(whitened**2, axis=1) + 2 * jnp.log(jnp.abs(stretches))
    log_scale = jnp.sum(jnp.log(jnp.diagonal(whitening))) - 3 * math.log(2 * math.pi)
    return jax.scipy.special.logsumexp(log_terms) + log_scale + LOG_CONTACT_JACOBIAN - 2 * jnp.log(sinc)


def _direction(height: jax.Array, uniform: jax.Array) -> jax.Array:
    azimuth = 2 * jnp.pi * uniform
    radius = jnp.sqrt(jnp.maximum(1 - height**2, 0))
    return jnp.stack([radius * jnp.cos(azimuth), radius * jnp.sin(azimuth), height])
