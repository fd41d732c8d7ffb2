"""How many things stand there, which and where: a search for the most probable scenes of one colour image.

Things are added one by one from the lattice, refined before they are compared. Where pixels are left that the
scene does not explain, joint moves follow: one thing is turned, replaced, dropped, split into two, or two are
merged into one. Scenes of each number and kinds are compared by Laplace's evidence at their best poses, which
gives p(N | image). A search: what it misses it does not count.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from scene.colour.lattice import OF_EACH_KIND, YAWS, Lattice, candidates
from scene.colour.light import LampShares
from scene.colour.posterior import ColourImage, Scene, colour_image, log_posterior, log_prior
from scene.colour.refinement import TURNED, Refined, refine, shaken
from scene.colour.rendering import render
from scene.colour.surroundings import Surroundings, parted
from scene.colour.weighing import FoundScene, Posed, Weighed, laplace_gains, weighed_scene
from scene.colour.world import TableWorld

COMPARED = 3
"""Refined candidates whose scenes are weighed together with their surroundings."""
FINER_YAWS = 4
"""Times the lattice's yaws are tried of a thing in place: 7.5 degrees, or a pixel at a handle's tip."""
MENDS = 12
"""Most moves that are taken: what a scene of three things of the wrong kinds needs."""
HANGS_ON_LITTLE = 3.0
"""Times the deviation of a place that one of a yaw is at a thing's rim where few pixels tell it."""
SETTLED = 4
"""Most times that all poses are refined, ..."""
WORTH_NATS = 1.0
"""... or moves tried, again after a gain of so much alone."""
EXPLAINED_NATS = 30.0
"""Excess of a scene below which moves are not tried: what a thing more costs by its prior."""
ALTERNATIVES = 4
"""Kinds that are tried in place of a thing, or of two, and another thing beside each: that a thing of one
kind explains most does not tell that it is one of the two that are there."""
MERGED_M = 0.12
"""Two things nearer than this may be one: the length of the largest of a table's usual things."""
DOUBTFUL_NATS = 20.0
"""Scenes within so much of the best are weighed exactly at last."""


@dataclass(eq=False)
class _Table:
    """The search on one image: the best scene of each number and kinds so far."""

    lattice: Lattice
    image: ColourImage
    found: dict[tuple[int, ...], Weighed] = field(default_factory=dict)
    grown: dict[bytes, list[Weighed]] = field(default_factory=dict)
    excess: dict[bytes, NDArray[np.float64]] = field(default_factory=dict)

    @property
    def world(self) -> TableWorld:
        """Of the lattice."""
        return self.lattice.world

    def _around(self, *scenes: Scene) -> Surroundings:
        """What stands in scenes to which a thing is to be added."""
        return Surroundings.of(self.world, self.image, scenes)

    def weigh(self, posed: Sequence[Posed]) -> list[Weighed]:
        """By Laplace; each is kept if it is the best of its number and kinds."""
        gains = laplace_gains(self.world, self.image, [scene for scene, _ in posed])
        weighed = []
        for (scene, covariance), gain in zip(posed, gains, strict=True):
            one = weighed_scene(self.world, scene, covariance, log_prior(self.world, scene) + float(gain))
            weighed.append(one)
            key = scene.kinds_there
            if key not in self.found or one.log_evidence > self.found[key].log_evidence:
                self.found[key] = one
        return weighed

    def added(self, base: Weighed) -> list[Weighed]:
        """The best scenes with one thing more, none where none fits; searched once for each scene."""
        key = _key(base.scene)
        if key not in self.grown:
            self.grown[key] = self._added(base)
        return self.grown[key]

    def _added(self, base: Weighed) -> list[Weighed]:
        around = self._around(base.scene)
        self.excess[_key(base.scene)] = around.excess[0]
        room = self.world.most - len(base.scene)
        found = candidates(self.lattice, around)
        if not room or not len(found.states):
            return []
        kinds, poses = self.lattice.kinds[found.states], self.lattice.poses[found.states]
        images = np.zeros(len(kinds), np.int64)
        refined = refine(self.world, around, kinds, poses, images, found.sites, COMPARED)
        return self.weigh(self._joined(base, refined, kinds[refined.which], found.sites[refined.which], room))

    def _joined(
        self,
        base: Weighed,
        refined: Refined,
        kinds: NDArray[np.int64],
        sites: NDArray[np.int64],
        room: int,
    ) -> list[Posed]:
        """The best thing of each site, as many as have room, and others in its place."""
        value = refined.log_evidence
        ranked = []
        for site in np.unique(sites):
            mine = np.flatnonzero(sites == site)
            mine = mine[np.argsort(-value[mine])][:COMPARED]
            ranked.append(mine[value[mine] > value[mine[0]] - DOUBTFUL_NATS])
        ranked = sorted(ranked, key=lambda mine: -value[mine[0]])[:room]
        first = [mine[0] for mine in ranked]
        sets = [first] + [
            [other if place == site else one for place, one in enumerate(first)]
            for site, mine in enumerate(ranked)
            for other in mine[1:]
        ]
        if len(first) > 1:
            sets += [first[:1]]
        posed = [_with_things(base, refined, kinds, some) for some in sets if some]
        return [(parted(self.world, scene), covariance) for scene, covariance in posed]

    def of_each_kind(self, base: Weighed) -> list[Weighed]:
        """The best scenes with one thing more, one of each kind, where most is unexplained; best first."""
        around = self._around(base.scene)
        wanted = OF_EACH_KIND * len(self.world.kinds)
        states = candidates(self.lattice, around, 1, wanted).states
        if not len(states) or len(base.scene) == self.world.most:
            return []
        kinds, images = self.lattice.kinds[states], np.zeros(len(states), np.int64)
        refined = refine(self.world, around, kinds, self.lattice.poses[states], images, kinds, 1)
        kinds = kinds[refined.which]
        every = self.weigh([_with_things(base, refined, kinds, [one]) for one in range(len(kinds))])
        return sorted(every, key=_evidence, reverse=True)[:ALTERNATIVES]

    def settled(self, weighed: Weighed) -> Weighed:
        """All things refined at once, each among the others as they are, as long as that is worth it."""
        return _as_long_as_worth_it(self._settled, weighed)

    def _settled(self, weighed: Weighed) -> Weighed:
        kinds, every = weighed.scene.kinds, np.arange(len(weighed.scene))
        around = self._around(*map(weighed.scene.without, range(len(kinds))))
        own = refine(self.world, around, kinds, weighed.scene.poses, every, every, 1, ())
        if len(own.which) < len(every):  # one is worth less than nothing where it is
            return weighed
        (one,) = self.weigh([(parted(self.world, Scene(kinds, own.poses)), own.covariance)])
        return max(weighed, one, key=_evidence)

    def shaken(self, weighed: Weighed) -> Weighed:
        """All things at the best of a few poses nearby, as long as that is worth it."""
        return _as_long_as_worth_it(self._shaken, weighed)

    def _shaken(self, weighed: Weighed) -> Weighed:
        kinds = weighed.scene.kinds
        around = self._around(*map(weighed.scene.without, range(len(kinds))))
        poses = shaken(self.world, around, kinds, weighed.scene.poses, weighed.covariance)
        if (poses == weighed.scene.poses).all():
            return weighed
        (one,) = self.weigh([(parted(self.world, Scene(kinds, poses)), weighed.covariance)])
        return max(weighed, self.settled(one), key=_evidence)

    def turned(self, weighed: Weighed, one: int) -> list[Weighed]:
        """One thing turned in place: the best of many yaws, refined."""
        kind = self.world.kinds[weighed.scene.kinds[one]]
        if not kind.turns:
            return []
        around = self._around(weighed.scene.without(one))
        count = FINER_YAWS * YAWS // kind.turns
        poses = np.tile(weighed.scene.poses[one], (count, 1))
        poses[:, 2] += np.arange(count) * (2 * np.pi / kind.turns / count)
        kinds, same = np.full(count, weighed.scene.kinds[one]), np.zeros(count, np.int64)
        own = refine(self.world, around, kinds, poses, same, same, COMPARED, TURNED)
        if not len(own.which):
            return []
        best = int(own.gains.argmax())
        scene_poses, covariance = weighed.scene.poses.copy(), weighed.covariance.copy()
        scene_poses[one], covariance[one] = own.poses[best], own.covariance[best]
        return self.weigh([(Scene(weighed.scene.kinds, scene_poses), covariance)])

    def spun(self, weighed: Weighed) -> Weighed:
        """Things whose yaw is told by little are turned right round: it may have other values."""
        for one, kind in enumerate(weighed.scene.kinds):
            variance = np.diag(weighed.covariance[one])
            reach = float(np.linalg.norm(self.world.kinds[kind].half_m))
            if reach * np.sqrt(variance[2]) > HANGS_ON_LITTLE * np.sqrt(variance[:2].max()):
                weighed = max([weighed, *self.turned(weighed, one)], key=_evidence)
        return weighed

    def lessened(self, weighed: Weighed) -> list[Weighed]:
        """Without each of its things."""
        return self.weigh([_without(weighed, one) for one in range(len(weighed.scene))])

    def moves(self, weighed: Weighed) -> Iterator[Weighed]:
        """Joint moves: turn, replace (kind and place), drop, split, merge, replace two that are near.

        Of things at which the scene leaves something unexplained.
        """
        suspects = self.suspects(weighed)
        bases = self.lessened(weighed)
        for one in suspects:
            yield from self.turned(weighed, one)
            replaced = self.of_each_kind(bases[one])
            yield from replaced
            yield bases[one]
            for other in replaced:
                yield from self.added(other)
        for pair in combinations(range(len(weighed.scene)), 2):
            apart = np.subtract(*weighed.scene.poses[list(pair), :2])
            if np.linalg.norm(apart) < MERGED_M and not suspects.isdisjoint(pair):
                (base,) = self.weigh([_without(weighed, *pair)])
                merged = self.of_each_kind(base)
                yield from merged
                for other in merged:
                    yield from self.added(other)

    def suspects(self, weighed: Weighed) -> set[int]:
        """Things in whose pixels something is unexplained."""
        excess = self.left(weighed)
        layers = render(self.world, weighed.scene.kinds, weighed.scene.poses)
        return set(layers.owner[excess[layers.pixel] > 0].tolist())

    def left(self, weighed: Weighed) -> NDArray[np.float64]:
        """Nats (H * W,) that a scene leaves unexplained."""
        self.added(weighed)
        return self.excess[_key(weighed.scene)]

    def mended(self, weighed: Weighed) -> Weighed:
        """The first scene by a move that gains; the same where there is none, or little to explain."""
        if self.left(weighed).sum() < EXPLAINED_NATS:
            return weighed
        for moved in self.moves(weighed):
            if moved.log_evidence > weighed.log_evidence + WORTH_NATS:
                return self.settled(moved)
        return weighed

    def summed(self, best: Weighed) -> FoundScene:
        """Probabilities over the scenes found; those in doubt are weighed exactly."""
        every = {}
        for key, one in self.found.items():
            if one.log_evidence > best.log_evidence - DOUBTFUL_NATS:
                density = log_posterior(self.world, self.image, one.scene)
                one = weighed_scene(self.world, one.scene, one.covariance, density)
            every[key] = one
        log_mass = np.array([one.log_evidence for one in every.values()])
        mass = np.exp(log_mass - log_mass.max())
        kinds = dict(zip(every, (mass / mass.sum()).tolist(), strict=True))
        numbers = [len(one) for one in kinds]
        count = np.bincount(numbers, weights=np.array(list(kinds.values())), minlength=self.world.most + 1)
        best = max(every.values(), key=_evidence)
        return FoundScene(best, kinds, np.asarray(count, np.float64), tuple(every.values()))


def _evidence(weighed: Weighed) -> float:
    return weighed.log_evidence


def _without(weighed: Weighed, *things: int) -> Posed:
    return weighed.scene.without(*things), np.delete(weighed.covariance, things, axis=0)


def _with_things(base: Weighed, refined: Refined, kinds: NDArray[np.int64], some: list[int]) -> Posed:
    """A scene and some of the things (B,), of these kinds, that were refined beside it."""
    scene = base.scene.joined(kinds[some], refined.poses[some])
    return scene, np.concatenate([base.covariance, refined.covariance[some]])


def _as_long_as_worth_it(better: Callable[[Weighed], Weighed], weighed: Weighed) -> Weighed:
    """A scene after some steps, the last of which gained less than `WORTH_NATS`; none of the empty table."""
    for _ in range(SETTLED if len(weighed.scene) else 0):
        before, weighed = weighed, better(weighed)
        if weighed.log_evidence < before.log_evidence + WORTH_NATS:
            break
    return weighed


def _key(scene: Scene) -> bytes:
    return scene.kinds.tobytes() + scene.poses.tobytes()


def find(lattice: Lattice, image: NDArray[np.floating]) -> FoundScene:
    """The most probable scene of an image (H, W, C) in 0..1, linear in light, its median the table.

    Args:
        lattice: rendered, of the image's camera; it serves every image.
        image: that is searched.
    """
    table = _Table(lattice, colour_image(lattice.world, image))
    (best,) = table.weigh([(Scene.empty(), np.zeros((0, 3, 3)))])
    while (more := max([best, *table.added(best)], key=_evidence)) is not best:
        best = table.settled(more)
    if (turned := table.spun(best)) is not best:
        best = table.settled(turned)
    for _ in range(MENDS):
        before, best = best, table.mended(best)
        if best is before:
            break
    best = table.shaken(best)
    table.lessened(best)
    return table.summed(best)


def find_under_any_lamp(
    lattice: Lattice, image: NDArray[np.floating]
) -> tuple[Lattice, FoundScene, LampShares]:
    """What is found under the lattice's lamp tells the lamp; the search is made again under the best one.

    Args:
        lattice: of any lamp.
        image: as `find` takes it.
    """
    found, world = find(lattice, image), lattice.world
    if not len(found.best.scene):
        return lattice, found, LampShares.known(world.light)
    lamps = LampShares.of(world, colour_image(world, image), found.best.scene)
    if lamps.most_probable != world.light:
        lattice = lattice.under(lamps.most_probable)
        found = find(lattice, image)
    return lattice, found, lamps
