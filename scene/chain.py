"""Chains over scenes: sweeps of moves, many chains side by side, long runs in blocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp

from scene.candidate_move import CandidateMove
from scene.involution import Move, MoveInfo, accept, propose
from scene.model import ChainState, SceneModel
from scene.pose_mixture import PoseMixture
from scene.pose_moves import FlipMove, MixtureMove, WalkMove
from scene.structure_move import StructureMove

Recorded = TypeVar("Recorded")

REPEATS = 4


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Kernel:
    """A sweep: a new edge and a new pose, REPEATS times over, then one of the other moves, in turn.

    Attributes:
        structure: the move of the graph; None keeps it fixed (the ablation 3DP3*).
        candidates: the move of poses.
        others: moves that carry along what rests on an object, or reach where the candidates do not.
        repeats: of the first two in a sweep.
    """

    structure: StructureMove | None
    candidates: CandidateMove
    others: tuple[Move, ...]
    repeats: int = field(default=REPEATS, metadata={"static": True})

    @property
    def moves(self) -> int:
        """In a sweep."""
        return self.repeats * (2 if self.structure else 1) + 1


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SweepInfo:
    """What happened in a sweep: the moves of the graph and of poses (repeats,), and the other one."""

    structure: MoveInfo | None
    candidates: MoveInfo
    other: MoveInfo

    @property
    def involution_error(self) -> jax.Array:
        """The largest of all that is in here."""
        infos = [info for info in (self.structure, self.candidates, self.other) if info is not None]
        return jnp.max(jnp.stack([jnp.max(info.involution_error) for info in infos]))


def scene_kernel(
    mixture: PoseMixture,
    *,
    prior_share: float,
    translation_m: jax.Array,
    rotation_rad: jax.Array,
    spread: float = 30.0,
    candidates: int = 6,
    near_share: float = 0.5,
    structure: StructureMove | None = None,
) -> Kernel:
    """The production kernel.

    Args:
        mixture: where each object might be.
        prior_share: weight of the prior in the mixture's draws.
        translation_m: (C,) largest standard deviations of a walk's step.
        rotation_rad: (C,) the same for angles.
        spread: the largest scale over the smallest.
        candidates: poses that are weighed together, the present one among them.
        near_share: how often they are drawn near the present pose.
        structure: the structure move; None keeps the graph fixed.
    """
    dtype = translation_m.dtype
    draw = MixtureMove(mixture, jnp.asarray(prior_share, dtype))
    walk = WalkMove(translation_m, rotation_rad, jnp.asarray(spread, dtype))
    return Kernel(
        structure, CandidateMove(draw, jnp.asarray(near_share, dtype), candidates), (walk, draw, FlipMove())
    )


def sweep(
    key: jax.Array,
    state: ChainState,
    model: SceneModel,
    kernel: Kernel,
    turn: jax.Array,
    *,
    verify: bool = False,
) -> tuple[ChainState, SweepInfo]:
    """One sweep of one chain; `turn` is a place among the other moves, the same for chains under `vmap`."""
    often_key, other_key = jax.random.split(key)

    def often(state: ChainState, number: jax.Array) -> tuple[ChainState, tuple[MoveInfo | None, MoveInfo]]:
        structure_key, candidates_key = jax.random.split(jax.random.fold_in(often_key, number))
        info = None
        if kernel.structure:
            state, info = _one_of(structure_key, state, model, (kernel.structure,), jnp.int32(0), verify)
        state, candidates_info = kernel.candidates.advance(candidates_key, state, model)
        return state, (info, candidates_info)

    state, (structure, candidates) = jax.lax.scan(often, state, jnp.arange(kernel.repeats))
    state, other = _one_of(other_key, state, model, kernel.others, turn, verify)
    return state, SweepInfo(structure, candidates, other)


def _one_of(
    key: jax.Array,
    state: ChainState,
    model: SceneModel,
    moves: tuple[Move, ...],
    index: jax.Array,
    verify: bool,
) -> tuple[ChainState, MoveInfo]:
    """One proposal by one of the moves, accepted or not."""
    move_key, likelihood_key, accept_key = jax.random.split(key, 3)
    offers = [partial(propose, model=model, move=move, verify=verify) for move in moves]
    offers = [lambda key, state, offer=offer: offer(key, state=state) for offer in offers]
    proposal = jax.lax.switch(index, offers, move_key, state)
    estimate = state.estimate
    if model.likelihood.depends_on_graph or any(move.moves_bodies for move in moves):
        moved = jnp.any(proposal.scene.poses != state.scene.poses, axis=1)
        estimate = model.likelihood.update(likelihood_key, proposal.scene, moved, estimate)
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
) -> tuple[ChainState, Recorded, SweepInfo]:
    """`count` sweeps of every chain in a batch (B, ...).

    Returns:
        The last states, `record(state)` after each sweep (count, B, ...), and Info (count, B, ...).
    """
    batch = states.log_prior.shape[0]

    def scan(states: ChainState, number: jax.Array) -> tuple[ChainState, tuple[Recorded, SweepInfo]]:
        keys = jax.random.split(jax.random.fold_in(key, number), batch)
        turn = number % len(kernel.others)
        advance = partial(sweep, model=model, kernel=kernel, turn=turn, verify=verify)
        states, info = jax.vmap(advance)(keys, states)
        return states, (jax.vmap(record)(states), info)

    states, (recorded, info) = jax.lax.scan(scan, states, jnp.arange(count))
    return states, recorded, info
