"""Chains over which objects are there, and what they say of presence.

Presence is estimated from the weights of each choice, not from the choice made (Rao-Blackwell): the mean over
steps of the probability that the object is there, given the options.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.execution import FAST_COMPILE
from scene.likelihood.shape_draws import candidate_keys
from scene.mcmc.involution import Move, choose, decide, propose, weigh
from scene.mcmc.pair_toggle import PairToggle
from scene.mcmc.random_variates import Variates
from scene.model.posterior import ChainState, SceneModel


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PresenceKernel:
    """A step: a toggle of a pair of slots, then each of the other moves once.

    Attributes:
        toggle: which objects are there.
        others: of their poses and edges.
    """

    toggle: PairToggle
    others: tuple[Move, ...] = ()


@partial(jax.jit, static_argnames="count", compiler_options=FAST_COMPILE)
def run_presence(
    key: jax.Array, states: ChainState, model: SceneModel, kernel: PresenceKernel, count: int
) -> tuple[ChainState, jax.Array, jax.Array]:
    """`count` steps of every chain in a batch (B, ...), whose estimates are up to date.

    Returns:
        The last states; the probability (count, B, C) of each slot being taken, given each step's options;
        which (count, B, C) are taken after the step.
    """

    def step(states: ChainState, number: jax.Array) -> tuple[ChainState, tuple[jax.Array, jax.Array]]:
        keys = jax.random.split(jax.random.fold_in(key, number), len(states.log_prior))
        states, expected = jax.vmap(partial(_step, model=model, kernel=kernel))(keys, states)
        return states, (expected, states.scene.present)

    states, (expected, present) = jax.lax.scan(step, states, jnp.arange(count))
    return states, expected, present


def _step(
    key: jax.Array, state: ChainState, model: SceneModel, kernel: PresenceKernel
) -> tuple[ChainState, jax.Array]:
    toggle_key, *other_keys = jax.random.split(key, 1 + len(kernel.others))
    state, expected = _toggled(toggle_key, state, model, kernel.toggle)
    for move_key, move in zip(other_keys, kernel.others, strict=True):
        state = _moved(move_key, state, model, move)
    return state, expected


def _toggled(
    key: jax.Array, state: ChainState, model: SceneModel, toggle: PairToggle
) -> tuple[ChainState, jax.Array]:
    dice_key, shape_key = jax.random.split(key)
    dice = Variates.draw(dice_key, (), 2 + toggle.uniforms, toggle.normals, state.log_prior.dtype)
    options = toggle.propose(dice.without(2), model, state)
    keys = candidate_keys(shape_key, 2 * toggle.count + 1)
    estimates = model.likelihood.offered(
        keys, options.offer.scenes, options.placed, state.estimate, anew=jnp.array(False)
    )
    log_priors, log_weights = weigh(model, state.log_prior, options.offer, estimates)
    chances = jax.nn.softmax(log_weights)
    expected = jnp.sum(chances[:, None] * options.offer.scenes.present, axis=0)
    state, _ = choose(dice.uniform[:2], model, options.offer, estimates, log_priors, log_weights)
    return state, expected


def _moved(key: jax.Array, state: ChainState, model: SceneModel, move: Move) -> ChainState:
    """After another move; where nothing is there that could be moved the state stays."""
    dice_key, shape_key = jax.random.split(key)
    uniforms = 2 + move.objects + move.uniforms
    dice = Variates.draw(dice_key, (), uniforms, move.normals, state.log_prior.dtype)
    offer = propose(dice.without(2), model, move, state, 2)
    some = jnp.any(state.scene.present & model.bodies.movable)
    off = jnp.where(some, offer.log_offered, jnp.array([0.0, jnp.inf]))
    offer = type(offer)(offer.scenes, off, offer.involution_error)
    moved = jnp.any(offer.scenes.poses != state.scene.poses[None], axis=2)
    keys = candidate_keys(shape_key, 2)
    estimates = model.likelihood.offered(keys, offer.scenes, moved, state.estimate, anew=jnp.array(False))
    decided, _ = decide(dice.uniform[:2], model, state.log_prior, offer, estimates)
    return decided


def presence_of(expected: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Presence (C,) and its standard error (C,) from chains (count, B, C), each a batch of its own.

    Raises:
        ValueError: there is but one chain, which has nothing to be compared with.
    """
    if expected.shape[1] < 2:
        raise ValueError("presence needs two chains or more, for its standard error")
    by_chain = np.asarray(expected, np.float64).mean(axis=0)
    return by_chain.mean(axis=0), by_chain.std(axis=0, ddof=1) / np.sqrt(len(by_chain))
