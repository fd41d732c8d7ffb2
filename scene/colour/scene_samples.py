"""Samples of the scenes of one colour image: number, kinds, lamp, and poses of the best scene's things.

Chains begin at scenes in proportion to the search's evidence: where they do not mix, its shares remain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from scene.colour.chains import State, Target, kinds_of, log_spins, sample_scenes
from scene.colour.light import LampShares
from scene.colour.posterior import ColourImage, Scene, log_posterior
from scene.colour.proposals import FoundThings
from scene.colour.weighing import FoundScene, Weighed
from scene.colour.world import TableWorld
from shapes.resampling import draw_systematically

FAR = 1e3
"""Metres between things of different kinds, when those of two scenes are paired."""


@dataclass(frozen=True, eq=False)
class SceneSamples:
    """Of all chains.

    Attributes:
        poses: (S, T, 3) of the T things of the best scene where its kinds are there, all chains of a sweep
            after each other.
        log_posterior: (S,).
        moved: share of sweeps after which the scene is another.
        kinds: of each chain, the share of its sweeps with each set of kinds.
    """

    poses: NDArray[np.float64]
    log_posterior: NDArray[np.float64]
    moved: float
    kinds: Sequence[dict[tuple[int, ...], float]]

    def at_least(self, kind: int, number: int) -> NDArray[np.float64]:
        """Share (chains,) of scenes with so many things of a kind, or more."""
        return np.array(
            [
                sum(share for kinds, share in chain.items() if kinds.count(kind) >= number)
                for chain in self.kinds
            ]
        )


def sampled(
    rng: np.random.Generator,
    world: TableWorld,
    image: ColourImage,
    found: FoundScene,
    lamps: LampShares,
    sweeps: int,
    chains: int,
) -> SceneSamples:
    """Chains on the exact posterior; their first third is dropped.

    Args:
        rng: random numbers.
        world: of the scenes.
        image: that was searched.
        found: by the search.
        lamps: that may light it.
        sweeps: of each chain.
        chains: how many.
    """
    things, target = FoundThings.of(world, found), _target(world, image, lamps)
    dropped, usual = sweeps // 3, int(lamps.log_shares.argmax())
    poses, values, kinds, moved = [], [], [], 0
    for start in _starts(rng, found, chains):
        state = State(start.scene, usual, target(start.scene, usual))
        every = sample_scenes(rng, target, state, things, len(world.kinds), lamps.log_shares, sweeps)
        states = list(every)[dropped:]
        moved += sum(one.scene is not other.scene for one, other in pairwise(states))
        kinds.append(kinds_of(states))
        own_poses, own_values = _of_best(world, states, found.best)
        poses.append(own_poses)
        values.append(own_values)
    by_sweep = np.stack(poses, axis=1)
    spins = world.spins[found.best.scene.kinds]
    by_sweep[..., spins, 2] = rng.uniform(0, 2 * np.pi, (*by_sweep.shape[:2], sum(spins)))
    share = moved / max(chains * (sweeps - dropped - 1), 1)
    return SceneSamples(np.concatenate(by_sweep), np.stack(values, axis=1).ravel(), share, kinds)


def _target(world: TableWorld, image: ColourImage, lamps: LampShares) -> Target:
    worlds = [replace(world, light=light) for light in lamps.lights]
    return lambda scene, lamp: log_posterior(worlds[lamp], image, scene) + log_spins(world, scene)


def _starts(rng: np.random.Generator, found: FoundScene, chains: int) -> list[Weighed]:
    """Scenes found, systematically in proportion to their shares, the best one first."""
    by_kinds = {one.scene.kinds_there: one for one in found.weighed}
    ordered = sorted(found.kinds, key=lambda kinds: -found.kinds[kinds])
    chosen = draw_systematically(rng, np.array([found.kinds[kinds] for kinds in ordered]), chains)
    return [by_kinds[ordered[one]] for one in chosen]


def _of_best(
    world: TableWorld, states: Sequence[State], best: Weighed
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (S, T, 3) and log densities (S,) of as many states, of those with the best scene's kinds."""
    same = [one for one in states if one.scene.kinds_there == best.scene.kinds_there]
    same = same or [State(best.scene, 0, best.log_density)]
    chosen = np.linspace(0, len(same) - 1, len(states)).round().astype(np.int64)
    paired = [_paired(world, one.scene, best.scene) for one in same]
    values = np.array([one.log_density for one in same])
    return np.array(paired)[chosen], values[chosen]


def _paired(world: TableWorld, scene: Scene, best: Scene) -> NDArray[np.float64]:
    """Poses (T, 3) in the order of the best scene's things; of yaws that look alike the nearest."""
    apart = np.linalg.norm(best.poses[:, None, :2] - scene.poses[None, :, :2], axis=-1)
    order = linear_sum_assignment(apart + FAR * (best.kinds[:, None] != scene.kinds[None]))[1]
    poses = scene.poses[order].copy()
    period = 2 * np.pi / np.maximum(world.turns[best.kinds], 1)
    poses[:, 2] -= period * np.round((poses[:, 2] - best.poses[:, 2]) / period)
    return poses
