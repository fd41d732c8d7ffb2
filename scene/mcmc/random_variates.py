"""Random variates of a sweep, drawn at once: one large draw compiles and runs sooner than many small ones."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Variates:
    """Independent numbers, each to be used once.

    Attributes:
        uniform: (..., U) in [0, 1).
        normal: (..., Z).
    """

    uniform: jax.Array
    normal: jax.Array

    @classmethod
    def draw(
        cls, key: jax.Array, lead: tuple[int, ...], uniforms: int, normals: int, dtype: jnp.dtype
    ) -> Variates:
        """Dice of leading axes `lead`."""
        uniform_key, normal_key = jax.random.split(key)
        return cls(
            jax.random.uniform(uniform_key, (*lead, uniforms), dtype),
            jax.random.normal(normal_key, (*lead, normals), dtype),
        )

    def without(self, uniforms: int) -> Variates:
        """Those that are left after the first uniform ones (U,)."""
        return Variates(self.uniform[uniforms:], self.normal)


def draw_index(weights: jax.Array, uniform: jax.Array) -> jax.Array:
    """Place in a short table (n,) of weights; the last place with a weight ends the table."""
    cumulative = jnp.cumsum(weights)
    place = jnp.sum(cumulative <= uniform * cumulative[-1])
    return jnp.minimum(place, jnp.max(jnp.where(weights > 0, jnp.arange(len(weights)), 0)))


def draw_object(eligible: jax.Array, uniform: jax.Array) -> jax.Array:
    """One of the eligible objects (C,), each as likely."""
    rank = jnp.floor(uniform * jnp.sum(eligible))
    return jnp.argmax(jnp.cumsum(eligible) > rank)


def draw_other_object(eligible: jax.Array, chosen: jax.Array, uniform: jax.Array) -> jax.Array:
    """Another of the eligible objects (C,) than the chosen one, each as likely; it again if it is alone."""
    rest = eligible & (jnp.arange(len(eligible)) != chosen)
    return jnp.where(jnp.any(rest), draw_object(rest, uniform), chosen)
