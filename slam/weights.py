"""Importance weights of particles: normalising, effective number, evidence."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def normalised(log_weights: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Normalised log weights (K,) and the log of their sum; all -inf becomes uniform with sum -inf."""
    log_sum = jax.nn.logsumexp(log_weights)
    uniform = jnp.full_like(log_weights, -jnp.log(float(len(log_weights))))
    return jnp.where(jnp.isfinite(log_sum), log_weights - log_sum, uniform), log_sum


def effective_sample_size(log_weights: jax.Array) -> jax.Array:
    """1 / sum w^2 of normalised log weights (K,), between 1 and K."""
    return jnp.exp(-jax.nn.logsumexp(2.0 * log_weights))
