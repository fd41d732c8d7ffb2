"""Unit quaternions wxyz (4,) in few array operations, each of which is compiled for itself."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np


def _products() -> np.ndarray:
    """T (4, 4, 4) with (a b)_k = sum_ij T_ijk a_i b_j."""
    table = np.zeros((4, 4, 4))
    table[0] = table[:, 0] = np.eye(4)
    for first, second, third in ((1, 2, 3), (2, 3, 1), (3, 1, 2)):
        table[first, first, 0] = -1
        table[first, second, third], table[second, first, third] = 1, -1
    return table


_PRODUCTS = _products()


def multiply(first: jax.Array, second: jax.Array) -> jax.Array:
    """The product: `second` is applied first."""
    return jnp.sum(_PRODUCTS * first[:, None, None] * second[None, :, None], axis=(0, 1))


def inverse(wxyz: jax.Array) -> jax.Array:
    """The rotation back."""
    return wxyz * np.array([1.0, -1.0, -1.0, -1.0])


def normalise(wxyz: jax.Array) -> jax.Array:
    """Of length 1."""
    return wxyz / jnp.linalg.norm(wxyz)


def rotate(wxyz: jax.Array, vector: jax.Array) -> jax.Array:
    """A vector (3,) turned."""
    return multiply(multiply(wxyz, jnp.concatenate([jnp.zeros(1, vector.dtype), vector])), inverse(wxyz))[1:]


def exp(vector: jax.Array) -> jax.Array:
    """The rotation about a vector (3,) by its length."""
    angle = _length(vector)
    return jnp.concatenate([jnp.cos(angle / 2)[None], vector * (jnp.sin(angle / 2) / angle)])


def log(wxyz: jax.Array) -> jax.Array:
    """The rotation vector (3,), not longer than pi."""
    sine, cosine = _length(wxyz[1:]), wxyz[0]
    half = jnp.arctan2(jnp.where(cosine < 0, -sine, sine), jnp.abs(cosine))
    return wxyz[1:] * (2 * half / sine)


def _length(vector: jax.Array) -> jax.Array:
    """Never 0, so that it can be divided by."""
    return jnp.sqrt(jnp.sum(vector * vector) + jnp.finfo(vector.dtype).tiny)
