"""A world of few states, of which all scenes can be summed: what chains say of one image, against the truth.

24 x 24 pixels, 6 x 6 places, four yaws, two kinds: 288 states, and 41,905 scenes of up to two of them,
repeats allowed, before the overlap rule. Albedos are unknown; the lamp is one of a set and summed over.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.benchmarks.air import searched
from pipeline.synthesis.air import TABLE_COLOUR, air_world
from scene.colour.chains import State, Target, kinds_of, log_spins, sample_scenes
from scene.colour.density import ColourNoise, sample
from scene.colour.lattice import Lattice
from scene.colour.posterior import (
    OVERLAP_M,
    ColourImage,
    Scene,
    colour_image,
    log_prior,
    overlap_depths,
    seen_together,
    segments_of,
    visible_gain,
)
from scene.colour.rendering import render
from scene.colour.world import Light, TableWorld

SIDE_PX = 24
PLACES, YAWS = 6, 4
KINDS = ("cube", "mug")
NOISE = ColourNoise(sigma=0.4, outlier=0.3)
"""So much that number or kinds are in doubt in every other image."""
LAMPS = (Light(), Light(direction=(0.6, -0.3, 0.6), ambient=0.2))
SWEEPS = 600_000
"""Of a chain: shares of kinds are then told to .003 or so, of the .01 that are asked."""
TAUGHT = (0.1, 0.2)
"""Parts of them that teach the proposal, one after the other, and are dropped."""
TOGETHER = 40
"""Scenes whose pixels are weighed at once: their quadrature stays in a cache."""
EVENLY = 0.3
"""Share of a chain's proposals that takes any state."""
TEMPERED = 8.0
"""Of the first ones: the gain of a second thing is a fraction of that of the first."""


@dataclass(frozen=True, eq=False)
class LatticeWorld:
    """The states, rendered under each lamp.

    Attributes:
        worlds: (L,) one of each lamp.
        lattices: (L,) the same states in each.
        possible: (S, S) pairs that the overlap rule allows.
        touching: (S, S) pairs that share pixels.
    """

    worlds: tuple[TableWorld, ...]
    lattices: tuple[Lattice, ...]
    possible: NDArray[np.bool_]
    touching: NDArray[np.bool_]

    @classmethod
    def of(cls, lamps: tuple[Light, ...] = LAMPS) -> LatticeWorld:
        """All states under these lamps."""
        whole = searched(air_world(SIDE_PX, SIDE_PX))
        kinds = tuple(one for one in whole.kinds if one.name in KINDS)
        world = replace(whole, kinds=kinds, most=2, noise=NOISE)
        states = _states(world)
        worlds = tuple(replace(world, light=light) for light in lamps)
        lattices = tuple(Lattice.rendered(one, *states, np.arange(len(states[0]))[None]) for one in worlds)
        shown = np.zeros((len(states[0]), SIDE_PX**2), np.float32)
        layers = lattices[0].layers
        shown[np.repeat(np.arange(len(shown)), np.diff(layers.start)), layers.pixel] = 1
        return cls(worlds, lattices, ~_overlaps(world, *states), shown @ shown.T > 0)

    def scene(self, *states: int) -> Scene:
        """Of states."""
        chosen = list(states)
        return Scene(self.lattices[0].kinds[chosen], self.lattices[0].poses[chosen])

    def drawn(self, rng: np.random.Generator) -> tuple[Scene, int, NDArray[np.float64]]:
        """A scene, its lamp and its image (H, W, 3), all by the model."""
        while True:
            states = rng.integers(len(self.possible), size=rng.integers(self.worlds[0].most + 1))
            if len(states) < 2 or self.possible[states[0], states[1]]:
                break
        scene, lamp = self.scene(*states.tolist()), int(rng.integers(len(self.worlds)))
        world = self.worlds[lamp]
        table = np.array(TABLE_COLOUR)
        empty = sample(rng, np.tile(table, (SIDE_PX, SIDE_PX, 1)), world.noise)
        image = colour_image(world, empty, table)
        view = seen_together(world, render(world, scene.kinds, scene.poses))
        segments = segments_of(world, image, view)
        albedo = rng.normal(world.noise.albedo_mean, world.noise.albedo_sd, (len(scene), 3))[segments.owner]
        rendered, sd = segments.own * albedo + segments.base, np.sqrt(segments.variances(albedo, world.noise))
        image.colour[view.place[view.leads]] = sample(rng, rendered, world.noise, sd)
        return scene, lamp, image.colour.reshape(SIDE_PX, SIDE_PX, 3)


@dataclass(frozen=True, eq=False)
class Summed:
    """Log posterior of every scene under every lamp, up to one constant.

    Attributes:
        empty: (L,).
        single: (L, S).
        pair: (L, S, S), symmetric.
    """

    empty: NDArray[np.float64]
    single: NDArray[np.float64]
    pair: NDArray[np.float64]

    @classmethod
    def of(cls, lattice: LatticeWorld, image: NDArray[np.float64]) -> Summed:
        """Render and weigh all of them; pairs that share no pixels are the sum of both."""
        every = [
            _log_posteriors(world, states, colour_image(world, image, np.array(TABLE_COLOUR)), lattice)
            for world, states in zip(lattice.worlds, lattice.lattices, strict=True)
        ]
        return cls(*(np.stack(part) for part in zip(*every, strict=True)))

    def kinds(self, kinds: NDArray[np.int64]) -> dict[tuple[int, ...], float]:
        """Exact probability of each set of kinds; `kinds` (S,) of the states."""
        total: dict[tuple[int, ...], list[NDArray[np.float64]]] = {(): [self.empty]}
        upper = np.triu(np.ones(self.pair.shape[1:], np.bool_))
        for one in np.unique(kinds).tolist():
            total[one,] = [self.single[:, kinds == one].ravel()]
            for other in range(one, kinds.max() + 1):
                mine = (kinds[:, None] == one) & (kinds == other)
                mine = upper & (mine | mine.T)
                total[one, other] = [self.pair[:, mine].ravel()]
        logs = {key: np.logaddexp.reduce(np.concatenate(parts)) for key, parts in total.items()}
        whole = np.logaddexp.reduce(list(logs.values()))
        return {key: float(np.exp(value - whole)) for key, value in logs.items()}


@dataclass(frozen=True, eq=False)
class LatticeThings:
    """Proposal of states.

    Attributes:
        lattice: the states.
        shares: (S,) which sum to 1.
        index: of a state by its kind and pose.
    """

    lattice: Lattice
    shares: NDArray[np.float64]
    index: Mapping[bytes, int]

    @classmethod
    def of(cls, lattice: Lattice, likely: NDArray[np.float64]) -> LatticeThings:
        """Mostly by weights (S,), else any state."""
        shares = EVENLY / len(likely) + (1 - EVENLY) * likely / likely.sum()
        numbers = zip(lattice.kinds, lattice.poses, strict=True)
        return cls(lattice, shares, {_key(*one): number for number, one in enumerate(numbers)})

    def states(self, scene: Scene) -> list[int] | None:
        """Their numbers, ascending; None for a scene that is not of the lattice."""
        found = [self.index.get(_key(*one)) for one in zip(scene.kinds, scene.poses, strict=True)]
        return None if None in found else sorted(one for one in found if one is not None)

    def draw(self, rng: np.random.Generator, count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Kinds (count,) and poses (count, 3)."""
        chosen = np.searchsorted(np.cumsum(self.shares), rng.random(count)).clip(0, len(self.shares) - 1)
        return self.lattice.kinds[chosen], self.lattice.poses[chosen]

    def log_density(self, kinds: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log shares (B,)."""
        chosen = [self.index[_key(*one)] for one in zip(kinds, poses, strict=True)]
        return np.log(self.shares[chosen])

    def step(self, rng: np.random.Generator, kind: int) -> NDArray[np.float64]:
        """To a neighbouring place."""
        del kind
        apart = np.ptp(self.lattice.poses[:, 0]) / (PLACES - 1)
        return apart * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])[rng.integers(4)]


def chain_kinds(
    rng: np.random.Generator, lattice: LatticeWorld, summed: Summed, sweeps: int = SWEEPS
) -> dict[tuple[int, ...], float]:
    """Share of a chain's sweeps with each set of kinds."""
    states, single = lattice.lattices[0], np.logaddexp.reduce(summed.single, axis=0)
    things = LatticeThings.of(states, np.exp((single - single.max()) / TEMPERED))
    target = _target(things, summed)
    lamps = np.full(len(lattice.worlds), -np.log(len(lattice.worlds)))
    state = State(Scene.empty(), 0, target(Scene.empty(), 0))
    for part in TAUGHT:
        visits = np.full(len(single), 1e-9)
        taught = sample_scenes(rng, target, state, things, len(KINDS), lamps, round(part * sweeps))
        for state in taught:
            visits[things.states(state.scene)] += 1
        things = LatticeThings.of(states, visits)
    last = sample_scenes(rng, target, state, things, len(KINDS), lamps, round((1 - sum(TAUGHT)) * sweeps))
    return kinds_of(last)


def measure_lattice(images: int, seed: int, progress: Callable[[int, int], None]) -> dict[str, Any]:
    """Chains against sums on so many images drawn from the model; progress is told images done and in all."""
    lattice = LatticeWorld.of()
    right, told, count_error, variation = [], [], [], []
    for number in range(images):
        rng = np.random.default_rng([seed + number, 11])
        scene, _, image = lattice.drawn(rng)
        summed = Summed.of(lattice, image)
        exact = summed.kinds(lattice.lattices[0].kinds)
        sampled = chain_kinds(rng, lattice, summed)
        counts = _counts(exact)
        right.append(int(counts.argmax()) == len(scene))
        told.append(float(counts.max()))
        count_error.append(float(np.abs(counts - _counts(sampled)).max()))
        variation.append(0.5 * sum(abs(exact[one] - sampled.get(one, 0.0)) for one in exact))
        progress(number + 1, images)
    return {
        "images": images,
        "scenes": 1 + len(lattice.possible) * (len(lattice.possible) + 3) // 2,
        "lamps": len(lattice.worlds),
        "count_right": float(np.mean(right)),
        "count_told": float(np.mean(told)),
        "largest_count_error": max(count_error),
        "largest_variation": max(variation),
        "mean_variation": float(np.mean(variation)),
    }


def lattice_lines(figures: dict[str, Any]) -> list[str]:
    """The figures as text."""
    return [
        f"{figures['images']} images; every one of {figures['scenes']:,} scenes, {figures['lamps']} lamps",
        f"ceiling, the exact posterior's own share of right counts: {figures['count_right']:.1%} "
        f"(it says {figures['count_told']:.1%})",
        f"chains against the sum: p(N) within {figures['largest_count_error']:.4f}, variation over kinds "
        f"at most {figures['largest_variation']:.4f}, mean {figures['mean_variation']:.4f}",
    ]


def _states(world: TableWorld) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    place = (np.arange(PLACES) + 0.5) * (2 * world.half_m / PLACES) - world.half_m
    poses = []
    for kind in world.kinds:
        yaw = np.arange(YAWS) * (2 * np.pi / YAWS / max(kind.turns, 1))
        poses.append(np.stack(np.meshgrid(place, place, yaw, indexing="ij"), axis=-1).reshape(-1, 3))
    return np.repeat(np.arange(len(poses)), len(poses[0])), np.concatenate(poses)


def _overlaps(world: TableWorld, kinds: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    count = len(kinds)
    both = np.repeat(kinds[:, None], count, axis=1), np.repeat(poses[:, None], count, axis=1)
    return overlap_depths(world, *both, both[0].T, both[1].swapaxes(0, 1))[0] > OVERLAP_M


def _log_posteriors(
    world: TableWorld, states: Lattice, image: ColourImage, lattice: LatticeWorld
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Of the empty table, each state (S,), and each pair (S, S)."""
    alone = visible_gain(world, image, seen_together(world, states.layers, np.arange(len(states.kinds))))
    gain = np.add.outer(alone, alone)
    one, other = np.nonzero(np.triu(lattice.possible & lattice.touching))
    for first in range(0, len(one), TOGETHER):
        part = slice(first, first + TOGETHER)
        both = np.column_stack([one[part], other[part]])
        seen = seen_together(world, states.layers.of(both.ravel()), np.repeat(np.arange(len(both)), 2))
        together = visible_gain(world, image, seen).reshape(-1, 2).sum(axis=1)
        gain[one[part], other[part]] = gain[other[part], one[part]] = together
    pair = np.argwhere(lattice.possible)[0].tolist()
    empty, single, double = (_log_mass(world, lattice.scene(*some)) for some in ([], [0], pair))
    return empty, single + alone, np.where(lattice.possible, double + gain, -np.inf)


def _log_mass(world: TableWorld, scene: Scene) -> float:
    """Log prior probability of a scene of states, each for its part of the square and turn."""
    cell = np.log((2 * world.half_m) ** 2 * 2 * np.pi / (PLACES**2 * YAWS))
    return log_prior(world, scene) + log_spins(world, scene) + len(scene) * float(cell)


def _target(things: LatticeThings, summed: Summed) -> Target:
    def value(scene: Scene, lamp: int) -> float:
        states = things.states(scene)
        if states is None or len(states) > 2:
            return -np.inf
        table = (summed.empty, summed.single, summed.pair)[len(states)]
        return float(table[(lamp, *states)])

    return value


def _counts(kinds: Mapping[tuple[int, ...], float]) -> NDArray[np.float64]:
    """Of each number of things (3,)."""
    every = np.bincount([len(one) for one in kinds], weights=list(kinds.values()), minlength=3)
    return np.asarray(every, np.float64)


def _key(kind: int, pose: NDArray[np.float64]) -> bytes:
    return np.array([kind, *np.rint(pose * 1e6)], np.int64).tobytes()
