"""Systematic resampling (Kitagawa 1996): one uniform draw places equally spaced points on the weights."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray


def resample_systematically(key: jax.Array, log_weights: jax.Array, count: int | None = None) -> jax.Array:
    """Ancestor indices (count,) int32, non-decreasing; index k is drawn floor or ceil of count w_k times.

    Args:
        key: consumed.
        log_weights: (K,) normalised.
        count: of draws; K by default.
    """
    count = len(log_weights) if count is None else count
    weights = jnp.exp(log_weights)
    cumulative = jnp.cumsum(weights)
    last_alive = len(log_weights) - 1 - jnp.argmax(weights[::-1] > 0)
    offset = jax.random.uniform(key, dtype=weights.dtype)
    points = (jnp.arange(count, dtype=weights.dtype) + offset) / count * cumulative[-1]
    return jnp.minimum(jnp.searchsorted(cumulative, points, side="right"), last_alive).astype(jnp.int32)


def draw_systematically(
    rng: np.random.Generator, weights: NDArray[np.float64], count: int
) -> NDArray[np.intp]:
    """The same in NumPy, of weights (K,) whose sum is 1."""
    places = (np.arange(count) + rng.random()) / count
    return np.minimum(np.searchsorted(np.cumsum(weights), places), len(weights) - 1)
