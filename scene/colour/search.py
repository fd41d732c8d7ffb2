"""How many things stand there, which and where: a search for the most probable scenes of one colour image.

Things are added one by one from the lattice, refined before they are compared; then joint moves: one thing is
replaced, dropped, split into two, or two are merged into one. Scenes of each number and kinds are compared by
Laplace's evidence at their best poses, which gives p(N | image). A search: what it misses it does not count.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from scene.colour.lattice import YAWS, Lattice, candidates, placed_gains, surroundings
from scene.colour.light import LampShares
from scene.colour.posterior import ColourImage, Scene, colour_image, log_posterior
from scene.colour.refinement import COARSE, FINE, Refined, refine
from scene.colour.world import Light, TableWorld

OF_EACH_KIND = 3
"""Candidates of each kind that are refined: a mug's handle may be taken to be on any side."""
COMPARED = 3
"""Refined candidates whose scenes are weighed exactly."""
FINER_YAWS = 4
"""Times the lattice's yaws are tried of a thing in place: 7.5 degrees, or a pixel at a handle's tip."""
TURNS_REFINED = 6
"""Best of them, which are refined."""
SWEEPS = 4
"""Most times that all moves are tried, ..."""
WORTH_NATS = 2.0
"""... again after a gain of so much alone: below it a pose was refined by another way."""
MERGED_TRIED = 2
"""Best replacements of two things by one beside which another one is tried."""
MERGED_M = 0.12
"""Two things nearer than this may be one: the length of the largest of a table's usual things."""


@dataclass(frozen=True, eq=False)
class Weighed:
    """A scene with its evidence.

    Attributes:
        scene: the things.
        sd: (N, 3) standard deviations of their poses, by curvature, each alone.
        log_density: `log_posterior`.
        log_evidence: of its number and kinds, by Laplace: density times the volume under the Gaussian.
    """

    scene: Scene
    sd: NDArray[np.float64]
    log_density: float
    log_evidence: float


@dataclass(frozen=True, eq=False)
class FoundScene:
    """What one image says.

    Attributes:
        best: the scene of the greatest evidence.
        kinds: probabilities of the kinds of things there, ascending, over the scenes that the search weighed.
        count: (most + 1,) of each number of things, likewise.
        weighed: the best scene of each number and kinds.
    """

    best: Weighed
    kinds: Mapping[tuple[int, ...], float]
    count: NDArray[np.float64]
    weighed: tuple[Weighed, ...]


@dataclass(eq=False)
class _Table:
    """The search on one image: the best scene of each number and kinds so far."""

    world: TableWorld
    lattice: Lattice
    image: ColourImage
    found: dict[tuple[int, ...], Weighed] = field(default_factory=dict)
    grown: dict[bytes, list[Weighed]] = field(default_factory=dict)

    def weigh(self, scene: Scene, sd: NDArray[np.float64]) -> Weighed:
        """Exactly; kept if it is the best of its number and kinds."""
        density = log_posterior(self.world, self.image, scene)
        turns = np.array([self.world.kinds[kind].turns for kind in scene.kinds], np.int64)
        volume = np.log(np.sqrt(2 * np.pi) * sd).sum() + np.log(np.maximum(turns, 1)).sum()
        weighed = Weighed(scene, sd, density, density + float(volume))
        key = tuple(sorted(scene.kinds.tolist()))
        if key not in self.found or weighed.log_evidence > self.found[key].log_evidence:
            self.found[key] = weighed
        return weighed

    def added(self, base: Weighed) -> list[Weighed]:
        """The best scenes with one thing more, none where none fits; searched once for each scene."""
        key = base.scene.kinds.tobytes() + base.scene.poses.tobytes()
        if key not in self.grown:
            self.grown[key] = self._added(base) if len(base.scene) < self.world.most else []
        return self.grown[key]

    def _added(self, base: Weighed) -> list[Weighed]:
        rest = surroundings(self.world, self.image, base.scene)
        states = candidates(self.world, self.image, rest, self.lattice, OF_EACH_KIND)
        if not len(states):
            return []
        kinds = self.lattice.kinds[states]
        refined = refine(self.world, self.image, rest, kinds, self.lattice.poses[states], COMPARED)
        value = refined.gains + np.log(refined.sd).sum(axis=1)
        return [
            self.weigh(
                base.scene.joined(int(kinds[refined.which[one]]), refined.poses[one]),
                np.concatenate([base.sd, refined.sd[one : one + 1]]),
            )
            for one in np.argsort(-value)[:COMPARED]
        ]

    def settled(self, weighed: Weighed, halvings: range = COARSE) -> Weighed:
        """Each thing refined among the others, in turn.

        Fine steps tell the top and not the width: pixels make the density rough at them.
        """
        for one in range(len(weighed.scene)):
            rest = surroundings(self.world, self.image, weighed.scene.without(one))
            mine = slice(one, one + 1)
            kinds, poses = weighed.scene.kinds[mine], weighed.scene.poses[mine]
            own = refine(self.world, self.image, rest, kinds, poses, 1, halvings)
            if halvings is FINE:
                own = replace(own, sd=weighed.sd[mine])
            weighed = max(weighed, self.weigh(*_replaced(weighed, one, own)), key=_evidence)
        return weighed

    def turned(self, weighed: Weighed, one: int) -> Weighed:
        """One thing turned in place: the best of many yaws, refined."""
        kind = self.world.kinds[weighed.scene.kinds[one]]
        if not kind.turns:
            return weighed
        rest = surroundings(self.world, self.image, weighed.scene.without(one))
        count = FINER_YAWS * YAWS // kind.turns
        poses = np.repeat(weighed.scene.poses[one : one + 1], count, axis=0)
        poses[:, 2] += np.arange(count) * (2 * np.pi / kind.turns / count)
        kinds = np.repeat(weighed.scene.kinds[one : one + 1], count)
        gains = placed_gains(self.world, self.image, rest, kinds, poses)
        best = np.argsort(-gains)[:TURNS_REFINED]
        own = refine(self.world, self.image, rest, kinds[best], poses[best], COMPARED)
        return self.weigh(*_replaced(weighed, one, own, int(own.gains.argmax())))

    def moves(self, weighed: Weighed) -> Iterator[Weighed]:
        """Joint moves: turn, drop, replace (kind and place), split, merge, replace two that are near, add."""
        for one in range(len(weighed.scene)):
            yield self.turned(weighed, one)
            base = self.weigh(weighed.scene.without(one), np.delete(weighed.sd, one, axis=0))
            yield base
            replaced = self.added(base)
            yield from replaced
            yield from self.added(max(replaced, key=_evidence)) if replaced else ()
        for pair in combinations(range(len(weighed.scene)), 2):
            apart = np.subtract(*weighed.scene.poses[list(pair), :2])
            if np.linalg.norm(apart) < MERGED_M:
                base = self.weigh(weighed.scene.without(*pair), np.delete(weighed.sd, pair, axis=0))
                merged = sorted(self.added(base), key=_evidence, reverse=True)
                yield from merged
                for one in merged[:MERGED_TRIED]:
                    yield from self.added(one)
        yield from self.added(weighed)


def _evidence(weighed: Weighed) -> float:
    return weighed.log_evidence


def _replaced(weighed: Weighed, one: int, own: Refined, which: int = 0) -> tuple[Scene, NDArray[np.float64]]:
    poses, sd = weighed.scene.poses.copy(), weighed.sd.copy()
    poses[one], sd[one] = own.poses[which], own.sd[which]
    return Scene(weighed.scene.kinds, poses), sd


@dataclass(frozen=True, eq=False)
class Searcher:
    """A world with its lattice rendered; `find` serves every image of its camera."""

    world: TableWorld
    lattice: Lattice

    @classmethod
    def of(cls, world: TableWorld) -> Searcher:
        """Render the lattice."""
        return cls(world, Lattice.of(world))

    def under(self, light: Light) -> Searcher:
        """The same under another lamp."""
        return Searcher(replace(self.world, light=light), self.lattice.under(light))

    def find(
        self, image: NDArray[np.floating], table_colour: NDArray[np.floating] | None = None
    ) -> FoundScene:
        """The most probable scene of an image (H, W, C) in 0..1.

        Args:
            image: linear in light.
            table_colour: (C,) of the empty table; None takes the image's median.
        """
        table = _Table(self.world, self.lattice, colour_image(self.world, image, table_colour))
        best = table.weigh(Scene.empty(), np.zeros((0, 3)))
        while (more := max([best, *table.added(best)], key=_evidence)) is not best:
            best = table.settled(more)
        for _ in range(SWEEPS):
            before = best
            if (moved := max([best, *table.moves(best)], key=_evidence)) is not best:
                best = table.settled(moved)
            if best.log_evidence < before.log_evidence + WORTH_NATS:
                break
        return _summed(table, table.settled(best, FINE))


def find_under_any_lamp(
    searcher: Searcher, image: NDArray[np.floating], table_colour: NDArray[np.floating] | None = None
) -> tuple[Searcher, FoundScene, LampShares]:
    """What is found under the searcher's lamp tells the lamp; the search is made again under the best one.

    Args:
        searcher: of any lamp.
        image: as `Searcher.find` takes it.
        table_colour: likewise.
    """
    found = searcher.find(image, table_colour)
    if not len(found.best.scene):
        return searcher, found, LampShares.known(searcher.world.light)
    view = colour_image(searcher.world, image, table_colour)
    lamps = LampShares.of(searcher.world, view, found.best.scene)
    if lamps.most_probable != searcher.world.light:
        searcher = searcher.under(lamps.most_probable)
        found = searcher.find(image, table_colour)
    return searcher, found, lamps


def _summed(table: _Table, best: Weighed) -> FoundScene:
    log_mass = np.array([weighed.log_evidence for weighed in table.found.values()])
    mass = np.exp(log_mass - log_mass.max())
    kinds = dict(zip(table.found, (mass / mass.sum()).tolist(), strict=True))
    numbers = [len(one) for one in kinds]
    count = np.bincount(numbers, weights=np.array(list(kinds.values())), minlength=table.world.most + 1)
    return FoundScene(best, kinds, np.asarray(count, np.float64), tuple(table.found.values()))
