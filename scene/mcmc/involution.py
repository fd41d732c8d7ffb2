"""Involutive Markov chain Monte Carlo: every move of the scene sampler is accepted or rejected here.

A move is an auxiliary density and an involution h on (scene, auxiliary). What the auxiliary density is
conditioned on, its context, is invariant under the move's own involution, so that it is computed once
for both directions. With log weight

    log p(s') - log p(s) + log q(a' | context) - log q(a | context) + log |det Dh|,     (s', a') = h(s, a),

the move is accepted with probability min(1, weight) (Cusumano-Towner et al. 2020; supplement O.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeVar

import jax
import jax.numpy as jnp

from scene.mcmc.random_variates import Variates, draw_index, draw_object, draw_other_object
from scene.model.posterior import ChainState, Estimate, SceneModel
from scene.model.scene_graph import SceneGraph

Tree = TypeVar("Tree")


class Move(Protocol):
    """One family of proposals for one object or two; a pytree with these methods."""

    objects: ClassVar[int]
    """How many a move is about: one, whose number is `chosen` below, or two, then (2,)."""
    uniforms: ClassVar[int]
    normals: ClassVar[int]
    """Numbers that a draw takes."""

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> Any:
        """What the auxiliary density depends on, the same at both ends of the move."""
        ...

    def sample(self, dice: Variates, context: Any) -> Any:
        """A draw of the auxiliary variables."""
        ...

    def log_density(self, context: Any, auxiliary: Any) -> jax.Array:
        """Its log density, up to a factor that the involution preserves."""
        ...

    def involution(
        self, model: SceneModel, scene: SceneGraph, chosen: jax.Array, auxiliary: Any
    ) -> tuple[SceneGraph, Any, jax.Array]:
        """h: the new scene, the auxiliary of the way back, log |det Dh| in the base measure."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CandidateSet:
    """Scenes side by side, the present one first, before their posterior densities are known.

    Attributes:
        scenes: leaves (K, C, ...).
        log_offered: (K,) what is taken off each log posterior density. By an involution, of the second
            scene: log q(a | context) - log q(a' | context) - log |det Dh|; +inf for places without use.
    """

    scenes: SceneGraph
    log_offered: jax.Array


def propose(model: SceneModel, move: Move, count: int, dice: Variates, state: ChainState) -> CandidateSet:
    """Choose the objects, draw the auxiliary variables and apply the involution.

    Args:
        model: the target.
        move: the family of proposals.
        count: K, places in the offer.
        dice: a number for each object, and those of the move.
        state: the chain.
    """
    scene = state.scene
    chosen, context, auxiliary = draw(dice, model, move, scene)
    there, reverse, log_jacobian = move.involution(model, scene, chosen, auxiliary)
    log_ratio = move.log_density(context, reverse) - move.log_density(context, auxiliary)
    log_forward = log_ratio + log_jacobian
    scenes = jax.tree.map(lambda new, old: repeat(old, count).at[1].set(new), there, scene)
    log_offered = jnp.full(count, jnp.inf, log_forward.dtype).at[:2].set(jnp.stack([0.0, -log_forward]))
    return compute_once(CandidateSet(scenes, log_offered))


def draw(dice: Variates, model: SceneModel, move: Move, scene: SceneGraph) -> tuple[jax.Array, Any, Any]:
    """The chosen object or objects, the context and the auxiliary variables of a move; as for `propose`."""
    eligible = scene.present & model.bodies.movable
    chosen = draw_object(eligible, dice.uniform[0])
    if move.objects == 2:
        chosen = jnp.stack([chosen, draw_other_object(eligible, chosen, dice.uniform[1])])
    context = compute_once(move.context(model, scene, chosen))
    return chosen, context, compute_once(move.sample(dice.without(move.objects), context))


def compute_once(values: Tree) -> Tree:
    """The same values; XLA would compute them anew for every one that reads them."""
    return jax.lax.optimization_barrier(values)


def repeat(leaf: jax.Array, count: int) -> jax.Array:
    """An array as often as there are places in an offer."""
    return jnp.broadcast_to(leaf[None], (count, *leaf.shape))


def decide(
    uniform: jax.Array, model: SceneModel, log_prior: jax.Array, offer: CandidateSet, estimates: Estimate
) -> tuple[ChainState, jax.Array]:
    """The scene that comes next, and whether it is another one, by Metropolised choice (Liu 1996).

    That is better than one in proportion to weights.

    Another than the present one is drawn in proportion to its weight, and accepted with probability
    min(1, (W - w of the present) / (W - w of the other)), W the sum: min(1, ratio) where there are two.

    Args:
        uniform: (2,) numbers.
        model: the target.
        log_prior: of the present scene.
        offer: the scenes.
        estimates: (K,) of their likelihoods.
    """
    others = jax.tree.map(lambda leaf: leaf[1:], offer.scenes)
    log_priors = jnp.concatenate([log_prior[None], jax.vmap(model.log_prior)(others)])
    log_weights = log_priors + estimates.log_likelihood - offer.log_offered
    weights = jnp.exp(log_weights - jnp.max(log_weights))
    to_others = weights.at[0].set(0.0)
    other = draw_index(to_others, uniform[0])
    rest = jnp.sum(jnp.where(jnp.arange(len(weights)) == other, 0.0, weights))
    place = compute_once(jnp.where(uniform[1] * rest < jnp.sum(to_others), other, 0).astype(jnp.int32))
    scene = jax.tree.map(lambda leaf: leaf[place], offer.scenes)
    state = ChainState(scene, log_priors[place], model.likelihood.chosen(estimates, place))
    return state, place > 0
