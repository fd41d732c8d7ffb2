"""The target of the chains: prior times likelihood, and the state that a chain carries."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp

from scene.graph import Bodies, SceneGraph
from scene.prior import PosePrior, StructurePrior, log_prior

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
        """An estimate with random numbers of its own, whose value `update` brings up to date."""
        ...

    def update(
        self, keys: jax.Array, scene: SceneGraph, moved: jax.Array, current: Estimate, *, anew: jax.Array
    ) -> Estimate:
        """The estimate at a proposed scene, where the objects in the mask `moved` (C,), few, have moved.

        Random numbers are made from keys (2,). With `anew` all of it is computed once more, for what has
        not moved with the same random numbers.
        """
        ...

    def of_candidates(
        self, keys: jax.Array, scene: SceneGraph, chosen: jax.Array, poses: jax.Array, current: Estimate
    ) -> jax.Array:
        """Log likelihoods (K,) with the chosen object at poses (K, 7), the first of which is the present one.

        That one keeps its stored estimate; each other has the one that `update` makes from its keys (K, 2).
        """
        ...


class BlindToPoses:
    """What a likelihood says of candidate poses that its data do not see."""

    def of_candidates(
        self,
        keys: jax.Array,  # noqa: ARG002
        scene: SceneGraph,  # noqa: ARG002
        chosen: jax.Array,  # noqa: ARG002
        poses: jax.Array,
        current: Estimate,
    ) -> jax.Array:
        """All alike."""
        return jnp.broadcast_to(current.log_likelihood, len(poses))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NoData(BlindToPoses):
    """The constant likelihood, under which every chain must return the prior."""

    depends_on_graph: ClassVar[bool] = False

    def start(self, key: jax.Array, scene: SceneGraph) -> Estimate:  # noqa: ARG002
        """Log 1, of no draws."""
        return Estimate(jnp.zeros((), scene.poses.dtype), ())

    def update(
        self,
        keys: jax.Array,  # noqa: ARG002
        scene: SceneGraph,  # noqa: ARG002
        moved: jax.Array,  # noqa: ARG002
        current: Estimate,
        *,
        anew: jax.Array,  # noqa: ARG002
    ) -> Estimate:
        """The same."""
        return current


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
