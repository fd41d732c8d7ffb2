"""The prior on which objects are there and on their graph: p(N) over sets, then p(G | N) over trees."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from scene.model.number_prior import NumberPrior
from scene.model.prior import WeightedTrees
from scene.model.scene_graph import ROOT


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FloatingTrees:
    """p(G_0 | N) = 1: nothing rests on anything (supplement L, eq. 6)."""

    def log_density(self, parents: jax.Array, present: jax.Array, movable: jax.Array) -> jax.Array:
        """0 where all float."""
        return jnp.where(jnp.all((parents == ROOT) | ~(present & movable)), 0.0, -jnp.inf)

    def log_floating_odds(self) -> jax.Array:
        """Nothing else is proposed."""
        return jnp.zeros(())


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CountedTrees:
    """Trees over the objects that are there, whose number is uncertain; a `StructurePrior`.

    The trees' density is normalised for every number of objects: with n of them and no table it changes by
    ((n + 1) / (n + 2))^n from one more, which chains over numbers must not leave out.

    Attributes:
        trees: p(G | N).
        log_sets: (slots + 1,) log probability of one given set of slots, by its size.
    """

    trees: WeightedTrees | FloatingTrees
    log_sets: jax.Array

    @classmethod
    def of(cls, number: NumberPrior, slots: int, trees: WeightedTrees | FloatingTrees) -> CountedTrees:
        """Of so many slots."""
        return cls(trees, jnp.asarray(number.log_set_probabilities(slots)))

    def log_density(self, parents: jax.Array, present: jax.Array, movable: jax.Array) -> jax.Array:
        """Log p(set) p(G | set)."""
        return self.log_sets[jnp.sum(present & movable)] + self.trees.log_density(parents, present, movable)

    def log_floating_odds(self) -> jax.Array:
        """Of the trees."""
        return self.trees.log_floating_odds()
