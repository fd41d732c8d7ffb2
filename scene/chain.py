"""Chains over scenes: a cycle of moves, many chains side by side, long runs in blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp

from scene.involution import Move, MoveInfo, accept, propose
from scene.model import ChainState, SceneModel
from scene.pose_mixture import PoseMixture
from scene.pose_moves import FlipMove, MixtureMove, WalkMove
from scene.structure_move import StructureMove

Recorded = TypeVar("Recorded")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Kernel:
    """A cycle of moves: `schedule` (M,) int32 names them in turn by their place in `moves`."""

    moves: tuple[Move, ...]
    schedule: jax.Array


def scene_kernel(
    mixture: PoseMixture,
    *,
    prior_share: float,
    translation_m: jax.Array,
    rotation_rad: jax.Array,
    spread: float = 30.0,
    structure: StructureMove | None = None,
) -> Kernel:
    """The production kernel: structure moves between walks, draws from the mixture and half turns.

    Args:
        mixture: where each object might be.
        prior_share: weight of the prior in the mixture's draws.
        translation_m: (C,) largest standard deviations of a walk's step.
        rotation_rad: (C,) the same for angles.
        spread: the largest scale over the smallest.
        structure: the structure move; None keeps the graph fixed (the ablation 3DP3*).
    """
    dtype = translation_m.dtype
    walk = WalkMove(translation_m, rotation_rad, jnp.asarray(spread, dtype))
    draw = MixtureMove(mixture, jnp.asarray(prior_share, dtype))
    if structure is None:
        return Kernel((walk, draw, FlipMove()), jnp.array([0, 0, 1, 0, 0, 2]))
    return Kernel((structure, walk, draw, FlipMove()), jnp.array([0, 2, 0, 2, 0, 1, 0, 2, 0, 2, 0, 3]))


def step(
    key: jax.Array,
    state: ChainState,
    model: SceneModel,
    kernel: Kernel,
    turn: jax.Array,
    *,
    verify: bool = False,
) -> tuple[ChainState, MoveInfo]:
    """One move of one chain; `turn` is a place in the schedule, the same for chains under `vmap`."""
    move_key, likelihood_key, accept_key = jax.random.split(key, 3)
    index = kernel.schedule[turn]
    proposals = [partial(propose, model=model, move=move, verify=verify) for move in kernel.moves]
    proposal = jax.lax.switch(
        index,
        [lambda key, state, offer=offer: offer(key, state=state) for offer in proposals],
        move_key,
        state,
    )
    likelihood = model.likelihood
    changes = jnp.asarray([move.moves_bodies or likelihood.depends_on_graph for move in kernel.moves])
    moved = jnp.any(proposal.scene.poses != state.scene.poses, axis=1)
    estimate = jax.lax.cond(
        changes[index],
        lambda: likelihood.update(likelihood_key, proposal.scene, moved, state.estimate),
        lambda: state.estimate,
    )
    return accept(accept_key, model, state, proposal, estimate)


@partial(jax.jit, static_argnames=("count", "record", "verify"))
def run_block(
    key: jax.Array,
    states: ChainState,
    model: SceneModel,
    kernel: Kernel,
    count: int,
    record: Callable[[ChainState], Recorded],
    *,
    verify: bool = False,
) -> tuple[ChainState, Recorded, MoveInfo]:
    """`count` moves of every chain in a batch (B, ...), the schedule from its start.

    Returns:
        The last states, `record(state)` after each move (count, B, ...), and Info (count, B).
    """
    turns = jnp.arange(count) % len(kernel.schedule)
    batch = states.log_prior.shape[0]

    def scan(states: ChainState, turn: jax.Array) -> tuple[ChainState, tuple[Recorded, MoveInfo]]:
        keys = jax.random.split(jax.random.fold_in(key, turn[1]), batch)
        advance = partial(step, model=model, kernel=kernel, turn=turn[0], verify=verify)
        states, info = jax.vmap(advance)(keys, states)
        return states, (jax.vmap(record)(states), info)

    states, (recorded, info) = jax.lax.scan(scan, states, jnp.stack([turns, jnp.arange(count)], axis=1))
    return states, recorded, info


def acceptance_rates(kernel: Kernel, info: MoveInfo) -> Sequence[float]:
    """Share of accepted moves for each of the kernel's moves, from a block's Info."""
    turns = jnp.arange(len(info.accepted)) % len(kernel.schedule)
    indices = kernel.schedule[turns]
    return [float(jnp.mean(info.accepted[indices == i])) for i in range(len(kernel.moves))]
