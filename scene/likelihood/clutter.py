"""Density of a pixel that shows none of the objects: background, or an unmodelled object."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise

UNKNOWN_SHARE = 0.5
"""Probability that a pixel of the foreground shows something unknown where it shows none of the objects."""

UNKNOWN_DEPTH_M = 0.5
"""Depths among which it lies, each as probable as the other."""


def log_density_without_objects(
    noise: DepthNoise,
    observed_m: jax.Array,
    background_m: jax.Array,
    foreground: jax.Array,
    surface_sigma_m: jax.Array | float = 0.0,
) -> jax.Array:
    """Log density of pixels where no object is, elementwise.

    In the foreground (1 - s) p(z | background) + s (1 - p_none) / reach: an object has to foretell depth
    better than something unknown would, which is anywhere on the table, and pays where it does not.

    Args:
        noise: of the sensor.
        observed_m: measured depth, or `NO_RETURN`.
        background_m: what is behind the objects, +inf where nothing is.
        foreground: bool, where something may stand.
        surface_sigma_m: error of the background's surface.
    """
    background = depth_noise.log_density(noise, observed_m, background_m, surface_sigma_m)
    unknown = jnp.where(
        observed_m == NO_RETURN,
        jnp.log(noise.none_hit_probability),
        jnp.log1p(-noise.none_hit_probability) - jnp.log(UNKNOWN_DEPTH_M),
    )
    mixed = jnp.logaddexp(jnp.log1p(-UNKNOWN_SHARE) + background, jnp.log(UNKNOWN_SHARE) + unknown)
    return jnp.where(foreground, mixed, background)
