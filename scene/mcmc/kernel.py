"""Chains over scenes: sweeps of moves, many chains side by side, long runs in blocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp

from scene.likelihood.shape_draws import candidate_keys
from scene.mcmc.independence_multiple_try import IndependenceMultipleTry
from scene.mcmc.involution import CandidateSet, Move, decide, propose, repeat
from scene.mcmc.local_multiple_try import LocalMultipleTry
from scene.mcmc.pose_mixture import PoseMixture
from scene.mcmc.random_variates import Variates
from scene.mcmc.symmetry_arrays import SpinLines, Symmetries
from scene.mcmc.walks import FlipMove, WalkMove
from scene.model.posterior import ChainState, Estimate, NoData, SceneModel
from shapes.stored_kernels import jit_stored

Recorded = TypeVar("Recorded")

WALK_SPREAD = 30.0
"""The largest scale of a walk's step over the smallest."""

_ANEW, _CANDIDATES = range(2)
"""Kinds of steps: the candidates by their place from the last on, and then the others."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Kernel:
    """A sweep: a new edge and a new pose, several times over, then an edge and another move, in turn.

    Attributes:
        structure: the move of the graph; None keeps it fixed (the ablation 3DP3*).
        candidates: the moves of poses, in turn.
        others: moves that carry along what rests on an object, or reach where the candidates do not.
        repeats: of the first two in a sweep.
    """

    structure: Move | None
    candidates: tuple[IndependenceMultipleTry | LocalMultipleTry, ...]
    others: tuple[Move, ...]
    repeats: int = field(metadata={"static": True})

    @property
    def moves(self) -> int:
        """In a sweep."""
        return (self.repeats + 1) * (2 if self.structure else 1)

    @property
    def mixture(self) -> PoseMixture:
        """Where each object might be."""
        return self.candidates[0].mixture

    def with_mixture(self, mixture: PoseMixture) -> Kernel:
        """The kernel with another mixture."""
        return replace(self, candidates=tuple(replace(one, mixture=mixture) for one in self.candidates))

    def kinds(self, number: jax.Array, anew: jax.Array) -> jax.Array:
        """What the steps (repeats + 1,) of a sweep do; candidates and others take turns."""
        place = jnp.arange(self.repeats + 1)
        candidates = _CANDIDATES + (place + number) % len(self.candidates)
        others = _CANDIDATES + len(self.candidates) + number % len(self.others)
        kinds = jnp.where(place < self.repeats, candidates, others)
        return jnp.where((place == 0) & anew, _ANEW, kinds)

    def draw(self, key: jax.Array, dtype: jnp.dtype) -> Variates:
        """Dice (repeats + 1,) of a sweep's steps: those of two moves, of their objects and decisions."""
        poses = (*self.candidates, *self.others)
        uniforms = 3 + max(move.uniforms for move in poses)
        if self.structure:
            uniforms += 2 + self.structure.objects + self.structure.uniforms
        return Variates.draw(key, (self.repeats + 1,), uniforms, max(move.normals for move in poses), dtype)


def scene_kernel(
    mixture: PoseMixture,
    *,
    prior_share: float,
    translation_m: jax.Array,
    rotation_rad: jax.Array,
    lines: SpinLines,
    symmetries: Symmetries,
    candidates: int = 6,
    repeats: int = 4,
    structure: Move | None = None,
) -> Kernel:
    """The production kernel.

    Args:
        mixture: where each object might be.
        prior_share: weight of the prior in the mixture's draws.
        translation_m: (C,) largest standard deviations of a walk's step.
        rotation_rad: (C,) the same for angles.
        lines: about which objects are round.
        symmetries: lines about which parts of a turn leave objects nearly as they are.
        candidates: poses that are weighed together, the present one among them.
        repeats: of candidates in a sweep, far and near ones in turn.
        structure: the structure move; None keeps the graph fixed.
    """
    dtype = translation_m.dtype
    walk = WalkMove(translation_m, rotation_rad, jnp.asarray(WALK_SPREAD, dtype))
    far = IndependenceMultipleTry(mixture, jnp.asarray(prior_share, dtype), candidates)
    near = LocalMultipleTry(mixture, lines, symmetries, candidates, grafts=structure is not None)
    return Kernel(structure, (far, near), (walk, FlipMove()), repeats)


def sweep(
    key: jax.Array,
    state: ChainState,
    model: SceneModel,
    kernel: Kernel,
    number: jax.Array,
    anew: jax.Array,
) -> tuple[ChainState, jax.Array]:
    """One sweep of one chain, and which of its steps (repeats + 1,) changed a pose.

    Args:
        key: random key.
        state: the chain.
        model: the target.
        kernel: the moves.
        number: of the sweep, the same for chains under `vmap`.
        anew: whether the estimate is to be computed once more first, in place of the first pose; likewise.
    """

    def step(state: ChainState, given: tuple[jax.Array, Variates, jax.Array]) -> tuple[ChainState, jax.Array]:
        number, dice, kind = given
        graph_key, pose_key = jax.random.split(jax.random.fold_in(step_key, number))
        if kernel.structure:
            state = _grafted(graph_key, dice, state, model, kernel.structure)
            dice = dice.without(2 + kernel.structure.objects + kernel.structure.uniforms)
        return _posed(pose_key, dice, state, model, kernel, kind)

    dice_key, step_key = jax.random.split(key)
    dice = kernel.draw(dice_key, state.log_prior.dtype)
    given = jnp.arange(kernel.repeats + 1), dice, kernel.kinds(number, anew)
    return jax.lax.scan(step, state, given)


def _grafted(key: jax.Array, dice: Variates, state: ChainState, model: SceneModel, move: Move) -> ChainState:
    """Another edge, poses as they are: data that see nothing else keep their estimate."""
    offer = propose(model, move, 2, dice.without(2), state)
    if not model.likelihood.depends_on_graph:
        blind = replace(model, likelihood=NoData())
        decided, _ = decide(
            dice.uniform[:2],
            blind,
            state.log_prior,
            offer,
            Estimate(jnp.zeros(2, offer.log_offered.dtype), ()),
        )
        return replace(decided, estimate=state.estimate)
    stand = jnp.zeros_like(offer.scenes.present)
    keys = candidate_keys(key, 2)
    estimates = model.likelihood.offered(keys, offer.scenes, stand, state.estimate, anew=jnp.array(False))
    return decide(dice.uniform[:2], model, state.log_prior, offer, estimates)[0]


def _posed(
    key: jax.Array,
    dice: Variates,
    state: ChainState,
    model: SceneModel,
    kernel: Kernel,
    kind: jax.Array,
) -> tuple[ChainState, jax.Array]:
    """Another pose by one of the moves, and whether it was accepted.

    All moves meet the target in one place, which is costly to compile.
    """
    count = kernel.candidates[0].count

    def same(dice: Variates, state: ChainState) -> CandidateSet:  # noqa: ARG001
        scenes = jax.tree.map(lambda leaf: repeat(leaf, count), state.scene)
        first = jnp.where(jnp.arange(count) == 0, jnp.zeros_like(state.log_prior), jnp.inf)
        return CandidateSet(scenes, first)

    offers = [
        same,
        *(partial(one.propose, model) for one in kernel.candidates),
        *(partial(propose, model, move, count) for move in kernel.others),
    ]
    offer = jax.lax.switch(kind, offers, dice.without(2), state)
    moved = jnp.any(offer.scenes.poses != state.scene.poses[None], axis=2)
    keys = candidate_keys(key, count)
    estimates = model.likelihood.offered(keys, offer.scenes, moved, state.estimate, anew=kind == _ANEW)
    return decide(dice.uniform[:2], model, state.log_prior, offer, estimates)


@jit_stored(
    static_argnames=("count", "record"),
    compiler_options={"xla_backend_optimization_level": 1},  # compiled sooner, and not slower
)
def run_block(
    key: jax.Array,
    states: ChainState,
    model: SceneModel,
    kernel: Kernel,
    count: int,
    record: Callable[[ChainState], Recorded],
) -> tuple[ChainState, Recorded, jax.Array]:
    """`count` sweeps of every chain in a batch (B, ...), whose estimates need not be up to date.

    Returns:
        The last states, `record(state)` after each sweep (count, B, ...), and which of its steps changed a
        pose (count, B, repeats + 1).
    """
    batch = states.log_prior.shape[0]

    def scan(states: ChainState, number: jax.Array) -> tuple[ChainState, tuple[Recorded, jax.Array]]:
        keys = jax.random.split(jax.random.fold_in(key, number), batch)
        advance = partial(sweep, model=model, kernel=kernel, number=number, anew=number == 0)
        states, accepted = jax.vmap(advance)(keys, states)
        return states, (jax.vmap(record)(states), accepted)

    states, (recorded, accepted) = jax.lax.scan(scan, states, jnp.arange(count))
    return states, recorded, accepted
