"""How many of the copies of a shape are there: a mean over moves, as presence, and not its product."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Visit(NamedTuple):
    """What a move of one slot knew before it chose.

    Attributes:
        slot: its number.
        probability: that it is there, given the others.
        others: (N,) which slots are there, itself left out.
    """

    slot: int
    probability: float
    others: NDArray[np.bool_]


def number_probabilities(visits: Sequence[Visit], alike: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Probabilities (N, N + 1) that so many are there of the shape of each of N objects.

    Args:
        visits: of moves of single slots; those beyond the N objects say nothing.
        alike: (N, N) which objects are copies of one shape, each of itself.
    """
    count = len(alike)
    sums = np.zeros((count, count + 1))
    for slot, probability, others in visits:
        if slot < count:
            beside = int((others[:count] & alike[slot]).sum())
            sums[slot, beside] += 1 - probability
            sums[slot, beside + 1] += probability
    together = np.maximum(alike @ sums, 0.0)  # probabilities may be above one by rounding
    return together / together.sum(axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class Copies:
    """Which objects are copies of one shape, and in which order they count.

    Copies are exchangeable, and moves change their places: that the k-th is there says that k or more are.

    Attributes:
        alike: (N, N) which are of one shape, each of itself.
        ranks: (N,) of each among those of its shape.
    """

    alike: NDArray[np.bool_]
    ranks: NDArray[np.intp]

    @classmethod
    def of(cls, alike: NDArray[np.bool_], found: NDArray[np.bool_]) -> Copies:
        """Those that the search `found` (N,) come first."""
        place = np.argsort(np.lexsort([np.arange(len(found)), ~found]))
        return cls(alike, (alike & (place[None] < place[:, None])).sum(axis=1))

    def with_number(self, presence: NDArray[np.float64], number: NDArray[np.float64]) -> NDArray[np.float64]:
        """Presence (..., N), of copies that of numbers (..., N, N + 1): that more are there than its rank."""
        fewer = np.cumsum(number, axis=-1)[..., np.arange(len(self.ranks)), self.ranks]
        return np.where(self._several, 1 - fewer, presence)

    def shared(self, shares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shares (..., N), those of copies given to the first of them: what is left over, at most 1."""
        return np.where(self._several, np.clip(shares @ self.alike - self.ranks, 0, 1), shares)

    def in_order(
        self, poses: NDArray[np.float64], in_use: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Poses (C, N, 7) of scenes, and which are in use (C, N), those in use given to the first copies."""
        poses, in_use = poses.copy(), in_use.copy()
        for group in np.unique(self.alike, axis=0):
            copies = np.flatnonzero(group)
            copies = copies[np.argsort(self.ranks[copies])]
            for scene in range(len(poses)):
                first = copies[np.argsort(~in_use[scene, copies], kind="stable")]
                poses[scene, copies], in_use[scene, copies] = poses[scene, first], in_use[scene, first]
        return poses, in_use

    @property
    def _several(self) -> NDArray[np.bool_]:
        return self.alike.sum(axis=1) > 1
