"""The objects that were found: chains carry them and no others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from scene.initialisation import Initialisation
from scene.rendering import OUT_OF_SIGHT

SLOTS = (1, 2, 3, 5, 8, 12, 18, 27)
"""Chains are compiled for so many objects, and for multiples of the last where there are more."""

Item = TypeVar("Item")


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundObjects:
    """Which of N objects take part, in slots of which the last may be empty.

    Attributes:
        indices: (F,) of those found, in order.
        slots: F or a few more, at least one.
        count: N.
    """

    indices: NDArray[np.intp]
    slots: int
    count: int

    @classmethod
    def of(cls, start: Initialisation) -> FoundObjects:
        """Those of the best scene."""
        indices = np.flatnonzero(start.found)
        enough = [slots for slots in SLOTS if slots >= len(indices)]
        slots = enough[0] if enough else -(-len(indices) // SLOTS[-1]) * SLOTS[-1]
        return cls(indices=indices, slots=slots, count=len(start.found))

    @property
    def placed(self) -> NDArray[np.intp]:
        """(slots,) whose object is in each slot; an empty one is made out of any."""
        return np.append(self.indices, np.zeros(self.slots - len(self.indices), np.intp))

    def taken(self, values: Sequence[Item]) -> list[Item]:
        """Of N things those of the slots."""
        return [values[index] for index in self.placed]

    def only(self, start: Initialisation) -> Initialisation:
        """The best scene and its pools of the slots alone; empty ones stand out of sight."""
        placed = self.placed
        is_empty = np.arange(self.slots) >= len(self.indices)
        return Initialisation(
            poses=np.where(is_empty[:, None], np.array(OUT_OF_SIGHT), start.poses[placed]),
            found=~is_empty,
            log_odds=start.log_odds[placed],
            pools=start.pools[placed],
            log_gains=start.log_gains[placed],
        )

    def spread(self, values: NDArray, others: NDArray) -> NDArray:
        """Samples (S, slots, ...) in their objects' places among `others` (S, N, ...)."""
        every = np.array(others, values.dtype)
        every[:, self.indices] = values[:, : len(self.indices)]
        return every

    def parents(self, parents: NDArray[np.integer]) -> NDArray[np.int32]:
        """Numbers of parents among N objects and the table, of numbers among slots and the table."""
        numbers = np.append(self.placed, [self.count, -1])  # the last is the root's, -1
        return numbers[parents].astype(np.int32)
