"""Chains over scenes: sweeps of moves, many chains side by side, long runs in blocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp

from scene.candidate_move import CandidateMove
from scene.involution import Move, MoveInfo, Proposal, accept, propose
from scene.model import ChainState, SceneModel
from scene.pose_mixture import PoseMixture
from scene.pose_moves import FlipMove, MixtureMove, WalkMove

Recorded = TypeVar("Recorded")

REPEATS = 4
_ANEW, _CANDIDATES, _OTHERS = range(3)
"""Kinds of steps; the others by their place from the last on."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Kernel:
    """A sweep: a new edge and a new pose, REPEATS times over, then an edge and another move, in turn.

    Attributes:
        structure: the move of the graph; None keeps it fixed (the ablation 3DP3*).
        candidates: the move of poses.
        others: moves that carry along what rests on an object, or reach where the candidates do not.
        repeats: of the first two in a sweep.
    """

    structure: Move | None
    candidates: CandidateMove
    others: tuple[Move, ...]
    repeats: int = field(default=REPEATS, metadata={"static": True})

    @property
    def moves(self) -> int:
        """In a sweep."""
        return (self.repeats + 1) * (2 if self.structure else 1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SweepInfo:
    """What happened in a sweep (repeats + 1,): to the graph, and to poses, by one of the others last."""

    structure: MoveInfo | None
    poses: MoveInfo

    @property
    def involution_error(self) -> jax.Array:
        """The largest of all that is in here."""
        infos = [info for info in (self.structure, self.poses) if info is not None]
        return jnp.max(jnp.stack([jnp.max(info.involution_error) for info in infos]))


def scene_kernel(
    mixture: PoseMixture,
    *,
    prior_share: float,
    translation_m: jax.Array,
    rotation_rad: jax.Array,
    axes: jax.Array,
    spread: float = 30.0,
    candidates: int = 6,
    near_share: float = 0.5,
    structure: Move | None = None,
) -> Kernel:
    """The production kernel.

    Args:
        mixture: where each object might be.
        prior_share: weight of the prior in the mixture's draws.
        translation_m: (C,) largest standard deviations of a walk's step.
        rotation_rad: (C,) the same for angles.
        axes: (C,) the box axis about which each object is round, or -1.
        spread: the largest scale over the smallest.
        candidates: poses that are weighed together, the present one among them.
        near_share: how often they are drawn near the present pose.
        structure: the structure move; None keeps the graph fixed.
    """
    dtype = translation_m.dtype
    draw = MixtureMove(mixture, jnp.asarray(prior_share, dtype))
    walk = WalkMove(translation_m, rotation_rad, jnp.asarray(spread, dtype))
    return Kernel(
        structure,
        CandidateMove(draw, jnp.asarray(near_share, dtype), axes, candidates),
        (walk, draw, FlipMove()),
    )


def sweep(
    key: jax.Array,
    state: ChainState,
    model: SceneModel,
    kernel: Kernel,
    turn: jax.Array,
    anew: jax.Array,
    *,
    verify: bool = False,
) -> tuple[ChainState, SweepInfo]:
    """One sweep of one chain.

    Args:
        key: random key.
        state: the chain.
        model: the target.
        kernel: the moves.
        turn: a place among the other moves, the same for chains under `vmap`.
        anew: whether the estimate is to be computed once more first, in place of the first pose; likewise.
        verify: apply every involution twice.
    """
    place = jnp.arange(kernel.repeats + 1)
    kinds = jnp.where(place < kernel.repeats, _CANDIDATES, _OTHERS + turn)
    kinds = jnp.where((place == 0) & anew, _ANEW, kinds)

    def step(
        state: ChainState, number_and_kind: tuple[jax.Array, jax.Array]
    ) -> tuple[ChainState, tuple[MoveInfo | None, MoveInfo]]:
        number, kind = number_and_kind
        structure_key, pose_key = jax.random.split(jax.random.fold_in(key, number))
        info = None
        if kernel.structure:
            state, info = _grafted(structure_key, state, model, kernel.structure, verify)
        state, pose_info = _posed(pose_key, state, model, kernel, kind, verify)
        return state, (info, pose_info)

    state, infos = jax.lax.scan(step, state, (place, kinds))
    return state, SweepInfo(*infos)


def _grafted(
    key: jax.Array, state: ChainState, model: SceneModel, move: Move, verify: bool
) -> tuple[ChainState, MoveInfo]:
    """Another edge, poses as they are."""
    move_key, accept_key = jax.random.split(key)
    proposal = propose(move_key, model, move, state, verify=verify)
    estimate = state.estimate
    if model.likelihood.depends_on_graph:
        stand = jnp.zeros_like(proposal.scene.present)
        estimate = model.likelihood.update(
            proposal.estimate_keys, proposal.scene, stand, estimate, anew=jnp.array(False)
        )
    return accept(accept_key, model, state, proposal, estimate)


def _posed(
    key: jax.Array, state: ChainState, model: SceneModel, kernel: Kernel, kind: jax.Array, verify: bool
) -> tuple[ChainState, MoveInfo]:
    """Another pose, by one of the moves; all meet the likelihood in one place, which is costly to compile."""
    move_key, accept_key = jax.random.split(key)

    def same(key: jax.Array, state: ChainState) -> Proposal:
        certain, no_error = jnp.full_like(state.log_prior, jnp.inf), jnp.zeros_like(state.log_prior)
        return Proposal(state.scene, certain, jax.random.split(key), no_error)

    def candidates(key: jax.Array, state: ChainState) -> Proposal:
        return kernel.candidates.propose(key, model, state)

    def by(move: Move) -> Callable[[jax.Array, ChainState], Proposal]:
        return lambda key, state: propose(key, model, move, state, verify=verify)

    offers = [same, candidates, *(by(move) for move in kernel.others)]
    proposal = jax.lax.switch(kind, offers, move_key, state)
    moved = jnp.any(proposal.scene.poses != state.scene.poses, axis=1)
    estimate = model.likelihood.update(
        proposal.estimate_keys, proposal.scene, moved, state.estimate, anew=kind == _ANEW
    )
    state, info = accept(accept_key, model, state, proposal, estimate)
    return state, replace(info, accepted=info.accepted & jnp.any(moved))


@partial(
    jax.jit,
    static_argnames=("count", "record", "verify"),
    compiler_options={"xla_backend_optimization_level": 1},  # compiled sooner, and not slower
)
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
    """`count` sweeps of every chain in a batch (B, ...), whose estimates need not be up to date.

    Returns:
        The last states, `record(state)` after each sweep (count, B, ...), and Info (count, B, ...).
    """
    batch = states.log_prior.shape[0]

    def scan(states: ChainState, number: jax.Array) -> tuple[ChainState, tuple[Recorded, SweepInfo]]:
        keys = jax.random.split(jax.random.fold_in(key, number), batch)
        turn = number % len(kernel.others)
        advance = partial(sweep, model=model, kernel=kernel, turn=turn, anew=number == 0, verify=verify)
        states, info = jax.vmap(advance)(keys, states)
        return states, (jax.vmap(record)(states), info)

    states, (recorded, info) = jax.lax.scan(scan, states, jnp.arange(count))
    return states, recorded, info
