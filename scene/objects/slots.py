"""Slots of detected objects: chains carry these and no others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

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
    def of(cls, found: NDArray[np.bool_]) -> FoundObjects:
        """Those that `found` (N,) tells."""
        indices = np.flatnonzero(found)
        enough = [slots for slots in SLOTS if slots >= len(indices)]
        slots = enough[0] if enough else -(-len(indices) // SLOTS[-1]) * SLOTS[-1]
        return cls(indices=indices, slots=slots, count=len(found))

    @property
    def placed(self) -> NDArray[np.intp]:
        """(slots,) whose object is in each slot; an empty one is made out of any."""
        return np.append(self.indices, np.zeros(self.slots - len(self.indices), np.intp))

    def taken(self, values: Sequence[Item]) -> list[Item]:
        """Of N things those of the slots."""
        return [values[index] for index in self.placed]

    @property
    def present(self) -> NDArray[np.bool_]:
        """(slots,) which slots are not empty."""
        return np.arange(self.slots) < len(self.indices)

    def poses(self, poses: NDArray[np.floating]) -> NDArray[np.float64]:
        """Poses (slots, 7) of those of all objects (N, 7); empty slots stand out of sight."""
        return np.where(self.present[:, None], poses[self.placed], np.array(OUT_OF_SIGHT))

    def spread(self, values: NDArray, others: NDArray) -> NDArray:
        """Samples (S, slots, ...) in their objects' places among `others` (S, N, ...)."""
        every = np.array(others, values.dtype)
        every[:, self.indices] = values[:, : len(self.indices)]
        return every

    def parents(self, parents: NDArray[np.integer]) -> NDArray[np.int32]:
        """Numbers of parents among N objects and the supports, of numbers among slots and the supports."""
        after = parents - self.slots
        numbers = self.placed[np.clip(parents, 0, self.slots - 1)]
        return np.where(parents < 0, parents, np.where(after < 0, numbers, self.count + after)).astype(
            np.int32
        )


OUT_OF_SIGHT = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)
"""A pose behind the camera, for what is not there."""
