"""Involutive Markov chain Monte Carlo: every move of the scene sampler is accepted or rejected here.

A move is an auxiliary density and an involution h on (scene, auxiliary). What the auxiliary density is
conditioned on, its context, is invariant under the move's own involution, so that it is computed once
for both directions. With log weight

    log p(s') - log p(s) + log q(a' | context) - log q(a | context) + log |det Dh|,     (s', a') = h(s, a),

the move is accepted with probability min(1, weight) (Cusumano-Towner et al. 2020; supplement O.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp

from scene.graph import SceneGraph
from scene.model import ChainState, Estimate, SceneModel


class Move(Protocol):
    """One family of proposals for one object; a pytree with these methods."""

    moves_bodies: ClassVar[bool]
    """Whether absolute poses change; if not, the likelihood of the data does not either."""

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> Any:
        """What the auxiliary density depends on, the same at both ends of the move."""
        ...

    def sample(self, key: jax.Array, context: Any) -> Any:
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
class Proposal:
    """What a move offers, before its posterior density is known.

    Attributes:
        scene: s'.
        log_forward: log q(a' | context) - log q(a | context) + log |det Dh|; +inf where the choice has
            been made already.
        estimate_keys: (2,) that make the random numbers of the new likelihood's estimate.
        involution_error: largest difference between (s, a), the log weight's negation included, and what
            applying h twice returns; 0 where this was not asked for.
    """

    scene: SceneGraph
    log_forward: jax.Array
    estimate_keys: jax.Array
    involution_error: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MoveInfo:
    """What happened: whether the move was accepted, and the check of its involution."""

    accepted: jax.Array
    involution_error: jax.Array


def propose(
    key: jax.Array, model: SceneModel, move: Move, state: ChainState, *, verify: bool = False
) -> Proposal:
    """Choose an object, draw the auxiliary variables and apply the involution.

    Args:
        key: random key.
        model: the target.
        move: the family of proposals.
        state: the chain.
        verify: apply the involution twice and report the difference.
    """
    object_key, auxiliary_key, estimate_key = jax.random.split(key, 3)
    scene = state.scene
    chosen = choose_object(object_key, scene.present & model.bodies.movable)
    context = move.context(model, scene, chosen)
    auxiliary = move.sample(auxiliary_key, context)
    there, reverse, log_jacobian = move.involution(model, scene, chosen, auxiliary)
    log_ratio = move.log_density(context, reverse) - move.log_density(context, auxiliary)
    log_forward = log_ratio + log_jacobian
    error = jnp.zeros((), scene.poses.dtype)
    if verify:
        back, again, log_jacobian_back = move.involution(model, there, chosen, reverse)
        context_there = move.context(model, there, chosen)
        log_ratio_back = move.log_density(context_there, again) - move.log_density(context_there, reverse)
        log_back = log_ratio_back + log_jacobian_back + model.log_prior(back) - state.log_prior
        asymmetry = jnp.where(jnp.isfinite(log_forward), jnp.abs(log_forward + log_back), 0)
        error = jnp.maximum(_difference(scene, back), asymmetry)
    return Proposal(there, log_forward, jax.random.split(estimate_key), error)


def accept(
    key: jax.Array, model: SceneModel, state: ChainState, proposal: Proposal, estimate: Estimate
) -> tuple[ChainState, MoveInfo]:
    """Keep the proposal with probability min(1, weight), else the state with its stored estimate."""
    proposed = ChainState(proposal.scene, model.log_prior(proposal.scene), estimate)
    log_weight = proposed.log_posterior - state.log_posterior + proposal.log_forward
    uniform = jax.random.uniform(key, dtype=log_weight.dtype)
    accepted = jnp.log(uniform) < log_weight
    chosen = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), proposed, state)
    return chosen, MoveInfo(accepted, proposal.involution_error)


def choose_object(key: jax.Array, eligible: jax.Array) -> jax.Array:
    """One of the eligible objects (C,), each as likely."""
    rank = jax.random.randint(key, (), 0, jnp.maximum(jnp.sum(eligible), 1))
    return jnp.argmax(jnp.cumsum(eligible) > rank)


def _difference(first: SceneGraph, second: SceneGraph) -> jax.Array:
    """Largest difference of two scenes; a different edge or face counts as infinite."""
    same = (
        jnp.all(first.parents == second.parents)
        & jnp.all(first.child_faces == second.child_faces)
        & jnp.all(first.parent_faces == second.parent_faces)
        & jnp.all(first.present == second.present)
    )
    sign = jnp.sign(jnp.sum(first.poses[:, :4] * second.poses[:, :4], axis=1, keepdims=True))
    rotation = jnp.max(jnp.abs(first.poses[:, :4] - sign * second.poses[:, :4]))
    translation = jnp.max(jnp.abs(first.poses[:, 4:] - second.poses[:, 4:]))
    return jnp.where(same, jnp.maximum(rotation, translation), jnp.inf)
