"""How many of the copies of a shape are there: a mean over moves, as presence, and not its product."""

from __future__ import annotations

from collections.abc import Sequence
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
    together = alike @ sums
    return together / together.sum(axis=1, keepdims=True)
