"""Markov chains over the scenes of one colour image: how many things, of which kind, where, under which lamp.

Every move leaves the posterior as it is (Green 1995). *Exchange*: some things, chosen evenly, go, and others
come from a proposal: birth, death, another in place of one, one of two, two of one, two for two. *Kind*:
another kind in the same pose. *Step*: a small one of a single pose. *Lamp*: another one of a fixed set. A
round thing carries a yaw as its prior has it, so that all kinds have three coordinates and no move stretches.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from scene.colour.posterior import Scene
from scene.colour.world import TableWorld
from scene.model.number_prior import log_choices

EXCHANGES = ((0, 1), (1, 0), (1, 1), (1, 2), (2, 1), (2, 2))
"""How many things go and come; each as often as its reverse."""


class Things(Protocol):
    """A proposal of single things that does not depend on the scene."""

    def draw(self, rng: np.random.Generator, count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Kinds (count,) and poses (count, 3)."""
        ...

    def log_density(self, kinds: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of draws (B,), in metres and radians, of round things in their yaw too."""
        ...

    def step(self, rng: np.random.Generator, kind: int) -> NDArray[np.float64]:
        """A displacement (3,), as likely as its opposite."""
        ...


@dataclass(frozen=True, eq=False)
class State:
    """Of a chain.

    Attributes:
        scene: the things.
        lamp: its number.
        log_density: of both, by the chain's target.
    """

    scene: Scene
    lamp: int
    log_density: float


Target = Callable[[Scene, int], float]
"""Log density of a scene under a lamp, spins of round things included."""


def log_spins(world: TableWorld, scene: Scene) -> float:
    """Log prior of the yaws that round things carry along."""
    return -np.log(2 * np.pi) * world.spins[scene.kinds].sum()


def sample_scenes(
    rng: np.random.Generator,
    target: Target,
    start: State,
    things: Things,
    kinds: int,
    log_lamps: NDArray[np.float64],
    sweeps: int,
) -> Iterator[State]:
    """The state after each sweep: every thing steps once, then one exchange, one change of kind, one of lamp.

    Args:
        rng: random numbers.
        target: of the chain.
        start: where it begins, of any density above zero.
        things: proposal of an exchange.
        kinds: how many there are.
        log_lamps: (L,) proposal of lamps.
        sweeps: how many.
    """
    state = start
    for _ in range(sweeps):
        for one in range(len(state.scene)):
            poses = state.scene.poses.copy()
            poses[one] += things.step(rng, int(state.scene.kinds[one]))
            state = _taken(rng, target, state, Scene(state.scene.kinds, poses), 0.0)
        state = _taken(rng, target, state, *exchanged(rng, state.scene, things))
        if kinds > 1 and len(state.scene):
            state = _taken(rng, target, state, _other_kind(rng, state.scene, kinds), 0.0)
        if len(log_lamps) > 1:
            lamp = int(rng.choice(len(log_lamps), p=np.exp(log_lamps)))
            weight = float(log_lamps[state.lamp] - log_lamps[lamp])
            state = _taken(rng, target, state, state.scene, weight, lamp)
        yield state


def exchanged(rng: np.random.Generator, scene: Scene, things: Things) -> tuple[Scene, float]:
    """Another scene, and the log weight of the move beside the ratio of the densities; -inf for none."""
    going, coming = EXCHANGES[int(rng.integers(len(EXCHANGES)))]
    if going > len(scene):
        return scene, -np.inf
    gone = rng.choice(len(scene), going, replace=False)
    kinds, poses = things.draw(rng, coming)
    after = scene.without(*gone.tolist()).joined(kinds, poses)
    back = things.log_density(scene.kinds[gone], scene.poses[gone])
    forth = things.log_density(kinds, poses)
    return after, exchange_weight(len(scene), back, forth)


def exchange_weight(things: int, back: NDArray[np.float64], forth: NDArray[np.float64]) -> float:
    """Log of the reverse exchange's probability over the exchange's own; scenes are unordered.

    Args:
        things: how many there are before.
        back: log densities of those that go.
        forth: of those that come.
    """
    after = things - len(back) + len(forth)
    return (
        float(back.sum() - forth.sum())
        + float(log_choices(things, len(back)))
        - float(log_choices(after, len(forth)))
        + float(gammaln(len(back) + 1) - gammaln(len(forth) + 1))
    )


def kinds_of(states: Iterable[State]) -> dict[tuple[int, ...], float]:
    """Share of the states with each set of kinds, ascending."""
    every = Counter(state.scene.kinds_there for state in states)
    return {kinds: every[kinds] / every.total() for kinds in sorted(every)}


def _other_kind(rng: np.random.Generator, scene: Scene, kinds: int) -> Scene:
    changed = scene.kinds.copy()
    one = int(rng.integers(len(scene)))
    changed[one] = (changed[one] + rng.integers(1, kinds)) % kinds
    return Scene(changed, scene.poses)


def _taken(
    rng: np.random.Generator,
    target: Target,
    state: State,
    scene: Scene,
    log_weight: float,
    lamp: int | None = None,
) -> State:
    """The state after a Metropolis test (Hastings 1970)."""
    if log_weight == -np.inf:
        return state
    lamp = state.lamp if lamp is None else lamp
    there = target(scene, lamp)
    if np.log(rng.random()) < there - state.log_density + log_weight:
        return State(scene, lamp, there)
    return state
