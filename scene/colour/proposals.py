"""Things that a chain over scenes may add: near those of the scenes that a search found, or anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.colour.weighing import FoundScene
from scene.colour.world import TableWorld

ANYWHERE = 0.1
"""Share drawn from the prior, so that a chain reaches all of it."""
TEMPERED = 4.0
"""Evidence of the scenes found is divided by it: what is 10 nats less probable alone may be right beside
another thing, and is offered once in a dozen times that the best is."""
SPREADS = (0.3, 1.0, 3.0)
"""Of draws and steps, in standard deviations by curvature: pixels make the posterior rough within one, and
its tails are longer than a Gaussian's."""
FAINTEST = -25.0
"""Least log share over the best one's, so that no kind's is zero."""
WRAPS = np.arange(-6, 7)
"""Turns over which a Gaussian of a yaw is summed: the widest, of a fourfold shape, reaches six."""


@dataclass(frozen=True, eq=False)
class FoundThings:
    """A mixture of Gaussians round things (M,) that were found, and the prior.

    Attributes:
        world: of the things.
        kinds: (M,).
        means: (M, 3).
        covariance: (M, 3, 3); of a round thing's yaw with nothing.
        shares: (M,), which sum to 1 - `ANYWHERE`, or to 0 of none.
    """

    world: TableWorld
    kinds: NDArray[np.int64]
    means: NDArray[np.float64]
    covariance: NDArray[np.float64]
    shares: NDArray[np.float64]

    @classmethod
    def of(cls, world: TableWorld, found: FoundScene) -> FoundThings:
        """Those of all scenes that a search weighed, the more probable ones' more often."""
        scenes = [one for one in found.weighed if len(one.scene)]
        log_shares = np.array([one.log_evidence / TEMPERED for one in scenes])
        shares = np.exp(np.maximum(log_shares - log_shares.max(initial=-np.inf), FAINTEST))
        counts = [len(one.scene) for one in scenes]
        each = np.repeat(shares / np.maximum(counts, 1), counts)
        return cls(
            world,
            np.concatenate([np.zeros(0, np.int64), *(one.scene.kinds for one in scenes)]),
            np.concatenate([np.zeros((0, 3)), *(one.scene.poses for one in scenes)]),
            np.concatenate([np.zeros((0, 3, 3)), *(one.covariance for one in scenes)]),
            (1 - ANYWHERE) * each / max(each.sum(), 1e-300),
        )

    @property
    def anywhere(self) -> float:
        """Share of the prior."""
        return ANYWHERE if len(self.kinds) else 1.0

    def draw(self, rng: np.random.Generator, count: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Kinds (count,) and poses (count, 3)."""
        side = self.world.half_m
        kinds = rng.integers(len(self.world.kinds), size=count)
        poses = rng.uniform([-side, -side, 0], [side, side, 2 * np.pi], (count, 3))
        near = np.flatnonzero(rng.random(count) >= self.anywhere)
        if len(near):
            chosen = rng.choice(len(self.kinds), size=len(near), p=self.shares / self.shares.sum())
            kinds[near] = self.kinds[chosen]
            poses[near] = self.means[chosen] + self._drawn(rng, chosen)
            turns = np.maximum(self.world.turns[kinds[near]], 1)
            poses[near, 2] += rng.integers(turns) * (2 * np.pi / turns)
            spins = near[self.world.turns[kinds[near]] == 0]
            poses[spins, 2] = rng.uniform(0, 2 * np.pi, len(spins))
            poses[:, 2] %= 2 * np.pi
        return kinds, poses

    def log_density(self, kinds: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Of draws (B,), in square metres and radians."""
        side = 2 * self.world.half_m
        inside = (np.abs(poses[:, :2]) <= self.world.half_m).all(axis=1)
        density = inside * (self.anywhere / (len(self.world.kinds) * side**2 * 2 * np.pi))
        apart = poses[:, None] - self.means  # (B, M, 3)
        turns, spins = self.world.turns[self.kinds], self.world.turns[self.kinds] == 0
        period = 2 * np.pi / np.maximum(turns, 1)
        apart[..., 2] -= period * np.round(apart[..., 2] / period)
        away = np.repeat(apart[:, :, None], len(WRAPS), axis=2)
        away[..., 2] += period[:, None] * WRAPS
        away[:, spins, :, 2] = 0.0
        squared = np.einsum("bmwi,mij,bmwj->bmw", away, np.linalg.inv(self.covariance), away)
        scale = np.sqrt(np.linalg.det(2 * np.pi * self.covariance))
        scale = np.where(spins, scale * 2 * np.pi, scale * np.maximum(turns, 1))
        same = (kinds[:, None] == self.kinds) * self.shares / scale / len(SPREADS)
        for spread in SPREADS:
            each = np.exp(-0.5 * squared / spread**2)
            each = np.where(spins, each[..., 0] / spread**2, each.sum(axis=-1) / spread**3)
            density = density + (same * each).sum(axis=1)
        with np.errstate(divide="ignore"):
            return np.log(density)

    def step(self, rng: np.random.Generator, kind: int) -> NDArray[np.float64]:
        """As wide as one of the Gaussians of the kind, or a hundredth of the table where there is none."""
        mine = np.flatnonzero(self.kinds == kind)
        if not len(mine):
            return rng.standard_normal(3) * [self.world.half_m / 50, self.world.half_m / 50, np.pi / 50]
        chosen = mine[rng.choice(len(mine), p=self.shares[mine] / self.shares[mine].sum())]
        return self._drawn(rng, np.array([chosen]))[0]

    def _drawn(self, rng: np.random.Generator, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
        """Displacements (B, 3) from things, of spreads chosen evenly."""
        spread = rng.choice(SPREADS, (len(chosen), 1)) * rng.standard_normal((len(chosen), 3))
        return np.einsum("bij,bj->bi", np.linalg.cholesky(self.covariance)[chosen], spread)
