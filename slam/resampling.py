"""Systematic resampling (Kitagawa 1996): one uniform draw places K equally spaced points on the weights."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def systematic(key: jax.Array, log_weights: jax.Array) -> jax.Array:
    """Ancestor indices (K,) int32, non-decreasing; particle k is drawn floor or ceil of K w_k times.

    Args:
        key: consumed.
        log_weights: (K,) normalised.
    """
    count = len(log_weights)
    weights = jnp.exp(log_weights)
    cumulative = jnp.cumsum(weights)
    last_alive = count - 1 - jnp.argmax(weights[::-1] > 0)
    offset = jax.random.uniform(key, dtype=weights.dtype)
    points = (jnp.arange(count, dtype=weights.dtype) + offset) / count * cumulative[-1]
    return jnp.minimum(jnp.searchsorted(cumulative, points, side="right"), last_alive).astype(jnp.int32)
