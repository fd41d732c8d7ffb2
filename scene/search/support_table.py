"""How the poses of pools rest on each other: the part of a scene's prior that looks at pairs."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SupportTable:
    """N objects with K poses each, the last that of the absent object, which rests and carries nothing.

    An object has the greatest log prior of all that it may rest on.

    Attributes:
        log_alone: (N, K) log prior of a pose by what is below it, were its object the only one.
        log_on: (N, K, N, K) of a pose by another object's pose below it, -inf where that is not below.
    """

    log_alone: jax.Array
    log_on: jax.Array

    @classmethod
    def sure(cls, objects: int, poses: int) -> SupportTable:
        """All poses rest, and none on another object."""
        nothing_on = np.full((objects, poses, objects, poses), -np.inf, np.float32)
        return cls(jax.device_put(np.zeros((objects, poses), np.float32)), jax.device_put(nothing_on))

    def of(self, choice: jax.Array) -> jax.Array:
        """Log prior (N,) of each object in the scene of a choice (N,)."""
        objects = jnp.arange(len(choice))
        on = self.log_on[objects[:, None], choice[:, None], objects[None], choice[None]]
        return jnp.maximum(self.log_alone[objects, choice], jnp.max(on, axis=1))

    def given(self, choice: jax.Array, index: jax.Array) -> jax.Array:
        """Log prior (K,) of a scene's objects together with each pose of one, given the others' choice."""
        without = self.of(choice.at[index].set(self.log_alone.shape[1] - 1))
        others = jnp.maximum(without[:, None], self._on(choice, index))
        return self._own(choice, index) + jnp.sum(others, axis=0)

    def of_pair(
        self, choice: jax.Array, one: tuple[jax.Array, jax.Array], other: tuple[jax.Array, jax.Array]
    ) -> jax.Array:
        """Log prior (A, B) of a scene's objects with two in given places (A,), (B,) of their pools."""
        (a, a_places), (b, b_places) = one, other
        others = choice.at[jnp.stack([a, b])].set(self.log_alone.shape[1] - 1)
        a_on_b = self.log_on[a, a_places[:, None], b, b_places[None]]
        b_on_a = self.log_on[b, b_places[None], a, a_places[:, None]]
        own = jnp.maximum(self._own(others, a)[a_places][:, None], a_on_b) + jnp.maximum(
            self._own(others, b)[b_places][None], b_on_a
        )
        on_a, on_b = self._on(others, a)[:, a_places], self._on(others, b)[:, b_places]
        on_either = jnp.maximum(on_a[:, :, None], on_b[:, None, :])
        return own + jnp.sum(jnp.maximum(self.of(others)[:, None, None], on_either), axis=0)

    def _own(self, choice: jax.Array, index: jax.Array) -> jax.Array:
        """Log prior (K,) of an object's poses among the others."""
        on = self.log_on[index][:, jnp.arange(len(choice)), choice]
        return jnp.maximum(self.log_alone[index], jnp.max(on, axis=1))

    def _on(self, choice: jax.Array, index: jax.Array) -> jax.Array:
        """Log prior (N, K) of every object on each pose of one."""
        return self.log_on[jnp.arange(len(choice)), choice, index]
