"""Draws of uncertain shapes: the random numbers of the pseudo-marginal likelihood (supplement N).

They are uniform over the known shapes. A new estimate draws new ones, all of them (Andrieu and Roberts 2009)
or a share (Deligiannidis, Doucet and Pitt 2018, the correlated form): either kernel is reversible with
respect to the uniform distribution, so that the chains are exact. They are redrawn twice, through choices
that all candidates of a move have in common: the joint density of all choices is then symmetric in the
candidates, the present one among them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def draw_shapes(key: jax.Array, shape: tuple[int, ...], known: int) -> jax.Array:
    """Choices among `known` shapes, int32."""
    return jax.random.randint(key, shape, 0, known, jnp.int32)


def redraw_shapes(keys: jax.Array, choices: jax.Array, known: int, share: jax.Array) -> jax.Array:
    """The choices with each drawn anew with probability `share`, by one key of (2,) and then by the other."""
    for key in keys:
        choice_key, coin_key = jax.random.split(key)
        anew = jax.random.uniform(coin_key, choices.shape) < share
        choices = jnp.where(anew, draw_shapes(choice_key, choices.shape, known), choices)
    return choices


def candidate_keys(key: jax.Array, count: int) -> jax.Array:
    """Keys (count, 2) of the candidates' choices: the first of each two is common to all."""
    own = jnp.arange(count)
    return jax.random.split(key, count + 1)[jnp.stack([jnp.full_like(own, count), own], axis=1)]
