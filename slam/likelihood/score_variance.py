"""Variance of a composite score, from the spread of the scores of blocks of pixels."""

from __future__ import annotations

import jax
import jax.numpy as jnp

LEAST_CURVATURE = 1e-6
"""Share of the curvature's trace plus one that is added to its diagonal: single precision, empty images."""

LEAST_FREEDOM = 1.0
"""Of the score's coordinates, where one block holds them nearly alone and its score tells nothing."""


def score_variance(scores: jax.Array, curvatures: jax.Array) -> jax.Array:
    """Variance (n, n) of the sum of scores (B, n) of blocks at the optimum, of curvatures (B, n, n).

    Errors of neighbouring pixels are correlated, those of blocks hardly: sum_b s_b s_b^T (Ribatet, Cooley
    and Davison 2012, section 2.2, for composite likelihoods). The optimum follows each block by its share
    A_b = H^-1 H_b of the curvature, so that the scores left there vary less than the errors: with V in
    proportion to H by sum_b tr(A_b - A_b^2) = n - sum_b tr A_b^2 in place of n (degrees of freedom, as
    Bell and McCaffrey 2002 for standard errors of clusters).
    """
    size = scores.shape[1]
    total = curvatures.sum(axis=0)
    floor = LEAST_CURVATURE * (1.0 + jnp.trace(total)) * jnp.eye(size, dtype=total.dtype)
    shares = jnp.linalg.inv(total + floor)[None] @ curvatures
    freedom = size - jnp.einsum("bij,bji->", shares, shares)
    return (size / jnp.maximum(freedom, LEAST_FREEDOM)) * (scores.T @ scores)
