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


def ranks_among_copies(alike: NDArray[np.bool_], found: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Rank (N,) of each object among the copies of its shape: those that the search found come first.

    Copies are exchangeable, and moves change their places: that the k-th is there says that k or more are.

    Args:
        alike: (N, N) which objects are copies of one shape, each of itself.
        found: (N,) by the search.
    """
    order = np.lexsort([np.arange(len(found)), ~found])
    place = np.argsort(order)
    return (alike & (place[None] < place[:, None])).sum(axis=1)


def more_than(number: NDArray[np.float64], ranks: NDArray[np.integer]) -> NDArray[np.float64]:
    """Probabilities (N,) that more are there than ranks (N,), of those of numbers (N, N + 1)."""
    return 1 - np.take_along_axis(np.cumsum(number, axis=1), ranks[:, None], axis=1)[:, 0]


def shares_by_rank(
    shares: NDArray[np.float64], alike: NDArray[np.bool_], ranks: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Shares (..., N) of the copies of a shape, given to the first of them: what is left over, at most 1."""
    return np.where(alike.sum(axis=1) > 1, np.clip(shares @ alike - ranks, 0, 1), shares)


def sorted_by_rank(
    poses: NDArray[np.float64],
    in_use: NDArray[np.bool_],
    alike: NDArray[np.bool_],
    ranks: NDArray[np.intp],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Poses (C, N, 7) of scenes, and which are in use (C, N), those in use given to the first copies."""
    poses, in_use = poses.copy(), in_use.copy()
    for group in np.unique(alike, axis=0):
        copies = np.flatnonzero(group)
        copies = copies[np.argsort(ranks[copies])]
        for scene in range(len(poses)):
            first = copies[np.argsort(~in_use[scene, copies], kind="stable")]
            poses[scene, copies], in_use[scene, copies] = poses[scene, first], in_use[scene, first]
    return poses, in_use
