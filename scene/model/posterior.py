"""The target of the chains: prior times likelihood, and the state that a chain carries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp

from scene.model.prior import PosePrior, StructurePrior, log_prior
from scene.model.scene_graph import Bodies, SceneGraph

MOST_MOVED = 3
"""Objects of which a move changes the pose."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Estimate:
    """An unbiased estimate of the likelihood of one scene.

    Attributes:
        log_likelihood: its log.
        draws: the random numbers it was made of (any pytree; empty for an exact likelihood), and whatever
            else saves work at the next evaluation. Part of the chain's state (supplement N).
    """

    log_likelihood: jax.Array
    draws: Any


class Likelihood(Protocol):
    """p(data | scene), exact or estimated without bias; a pytree with these methods.

    `depends_on_graph` is False for real data: they see absolute poses only, so that a structure move
    keeps the stored estimate.
    """

    depends_on_graph: ClassVar[bool]

    def start(self, key: jax.Array, scene: SceneGraph) -> Estimate:
        """An estimate with random numbers of its own, whose value is to be made anew."""
        ...

    def offered(
        self, keys: jax.Array, scenes: SceneGraph, moved: jax.Array, current: Estimate, *, anew: jax.Array
    ) -> Estimate:
        """Estimates (K,) of scenes with leading axis K, the first of which is the present one.

        That one keeps its estimate, unless with `anew` it is computed once more with the same random
        numbers; the others' are made from their keys (K, 2).

        Args:
            keys: (K, 2).
            scenes: leaves (K, C, ...).
            moved: (K, C) the objects that stand elsewhere than at present; at most K - 1 of all, or
                MOST_MOVED.
            current: of the present scene.
            anew: () bool.
        """
        ...

    def chosen(self, offered: Estimate, place: jax.Array) -> Estimate:
        """One of the estimates, of which no other is needed any more."""
        ...


class SeparateLikelihoods:
    """Estimates side by side that have nothing in common."""

    def chosen(self, offered: Estimate, place: jax.Array) -> Estimate:
        """The estimate in its place."""
        return jax.tree.map(lambda leaf: leaf[place], offered)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NoData(SeparateLikelihoods):
    """The constant likelihood, under which every chain must return the prior."""

    depends_on_graph: ClassVar[bool] = False

    def start(self, key: jax.Array, scene: SceneGraph) -> Estimate:  # noqa: ARG002
        """Log 1, of no draws."""
        return Estimate(jnp.zeros((), scene.poses.dtype), ())

    def offered(
        self,
        keys: jax.Array,  # noqa: ARG002
        scenes: SceneGraph,
        moved: jax.Array,  # noqa: ARG002
        current: Estimate,  # noqa: ARG002
        *,
        anew: jax.Array,  # noqa: ARG002
    ) -> Estimate:
        """All alike."""
        return Estimate(jnp.zeros(len(scenes.poses), scenes.poses.dtype), ())


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SceneModel:
    """p(G) p(theta | G) p(data | scene) over the given bodies."""

    bodies: Bodies
    prior: PosePrior
    structure: StructurePrior
    likelihood: Likelihood

    def log_prior(self, scene: SceneGraph) -> jax.Array:
        """Log p(G) p(theta | G) in the base measure of supplement O."""
        return log_prior(self.prior, self.structure, self.bodies, scene)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ChainState:
    """One chain: the scene, its log prior and the stored estimate of its likelihood."""

    scene: SceneGraph
    log_prior: jax.Array
    estimate: Estimate

    @property
    def log_posterior(self) -> jax.Array:
        """Log prior + log likelihood, not normalised."""
        return self.log_prior + self.estimate.log_likelihood


def start_chain(key: jax.Array, model: SceneModel, scene: SceneGraph) -> ChainState:
    """The state of a chain that starts at a scene; its first step brings the estimate up to date."""
    return ChainState(scene, model.log_prior(scene), model.likelihood.start(key, scene))
