"""The one sensor density (docs/model.md, section 0), shared by slam, shapes and scene.

A pixel is a real depth z or the atom "no return". Base measure: Lebesgue in metres on the reals, plus
a point mass on `NO_RETURN`. All functions are elementwise and broadcast.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise

jax.tree_util.register_dataclass(DepthNoise)


Depth = TypeVar("Depth", jax.Array, NDArray[np.floating])


def standard_deviation(noise: DepthNoise, rendered_m: Depth) -> Depth:
    """sigma(z~) in metres for a surface at `rendered_m`."""
    return noise.sigma_base_m + noise.sigma_growth_per_m * (rendered_m - 0.4) ** 2


def with_surface_error(noise: DepthNoise, sigma_m: float) -> DepthNoise:
    """The noise where surfaces are known to `sigma_m` only, which adds its variance at 0.4 m."""
    return replace(noise, sigma_base_m=math.hypot(noise.sigma_base_m, sigma_m))


def log_density_of_hit(
    noise: DepthNoise, observed_m: jax.Array, rendered_m: jax.Array, surface_sigma_m: jax.Array | float = 0.0
) -> jax.Array:
    """Log density of a pixel whose ray meets a surface at `rendered_m`.

    p_none_hit delta_none + (1 - p_none_hit) [p_out 1[0 <= z <= D] / D + (1 - p_out) Normal(z; z~, sigma)].
    The Normal is neither truncated nor clipped, also at z~ = D. A surface that is itself known only to
    `surface_sigma_m` adds its variance.
    """
    sigma = jnp.hypot(standard_deviation(noise, rendered_m), surface_sigma_m)
    log_normal = -0.5 * ((observed_m - rendered_m) / sigma) ** 2 - jnp.log(sigma) - 0.5 * jnp.log(2 * jnp.pi)
    log_return = jnp.log1p(-noise.none_hit_probability) + jnp.logaddexp(
        jnp.log(noise.outlier_probability) + _log_uniform(noise, observed_m),
        jnp.log1p(-noise.outlier_probability) + log_normal,
    )
    return jnp.where(observed_m == NO_RETURN, jnp.log(noise.none_hit_probability), log_return)


def log_density_of_miss(noise: DepthNoise, observed_m: jax.Array) -> jax.Array:
    """Log density of a pixel whose ray meets nothing: the atom, or uniform on [0, D]."""
    log_return = jnp.log1p(-noise.none_miss_probability) + _log_uniform(noise, observed_m)
    return jnp.where(observed_m == NO_RETURN, jnp.log(noise.none_miss_probability), log_return)


def log_density(
    noise: DepthNoise, observed_m: jax.Array, rendered_m: jax.Array, surface_sigma_m: jax.Array | float = 0.0
) -> jax.Array:
    """Log density of a pixel given a rendered depth that is infinite where the ray meets nothing."""
    hit = jnp.isfinite(rendered_m)
    return jnp.where(
        hit,
        log_density_of_hit(noise, observed_m, jnp.where(hit, rendered_m, 1.0), surface_sigma_m),
        log_density_of_miss(noise, observed_m),
    )


def sample(
    key: jax.Array, noise: DepthNoise, rendered_m: jax.Array, normals: jax.Array | None = None
) -> jax.Array:
    """Draw of every pixel given a rendered depth (infinite where the ray meets nothing).

    `normals` are the pixels' residuals in standard deviations, where they are not independent.
    """
    none_key, outlier_key, uniform_key, normal_key = jax.random.split(key, 4)
    shape = rendered_m.shape
    hit = jnp.isfinite(rendered_m)
    surface = jnp.where(hit, rendered_m, 1.0)
    outlier = jax.random.uniform(uniform_key, shape, maxval=noise.max_range_m)
    residuals = jax.random.normal(normal_key, shape) if normals is None else normals
    inlier = surface + standard_deviation(noise, surface) * residuals
    is_outlier = ~hit | jax.random.bernoulli(outlier_key, noise.outlier_probability, shape)
    none_probability = jnp.where(hit, noise.none_hit_probability, noise.none_miss_probability)
    is_none = jax.random.bernoulli(none_key, none_probability)
    return jnp.where(is_none, NO_RETURN, jnp.where(is_outlier, outlier, inlier))


def _log_uniform(noise: DepthNoise, observed_m: jax.Array) -> jax.Array:
    inside = (observed_m >= 0) & (observed_m <= noise.max_range_m)
    return jnp.where(inside, -jnp.log(noise.max_range_m), -jnp.inf)
