"""The prior of poses with the scene graph summed out: a determinant.

Given the poses of n objects a graph's prior is a product over its edges, so that the sum over all graphs is
the sum over spanning trees from the root, and that is a determinant (the matrix-tree theorem; Tutte 1948):
with w_i the weight of object i on the root or on what does not move, and w_ij that of i on j,

    sum over graphs of prod of edges = det(diag_i(w_i + sum_j w_ij) - [w_ij]).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class ForestPrior:
    """Log prior of which of N slots hold an object, and of candidate poses of those that do.

    Attributes:
        on_root: (N, K) weight of each candidate by itself: floating, or on a support.
        weights_beside: of a slot and its candidate the weights (2, N, K) of every candidate on that one, and
            of that one on every candidate; 0 within the slot. It is asked again and again of what is taken.
        log_trees: (N + 1,) log of the sum of the weights of all trees over so many objects.
        log_sets: (A + 1,) log probability of one given set of slots that are asked for, by its size.
        asked: A, the first of the slots; the others' rates are part of their weights.
        log_apart: of a slot and its candidate log factors (A, K) of how deep all others reach into that one,
            or it into them, 0 within the slot; None where things may.
    """

    on_root: NDArray[np.float64]
    weights_beside: Callable[[int, int], NDArray[np.float64]]
    log_trees: NDArray[np.float64]
    log_sets: NDArray[np.float64]
    asked: int
    log_apart: Callable[[int, int], NDArray[np.float64]] | None = None

    def log_density(self, taken: Sequence[tuple[int, int]], hidden: int) -> float:
        """Of slots at candidates (slot, place), and so many others somewhere out of sight."""
        place = tuple(taken), None
        if place not in self._kept:
            self._kept[place] = self._log_forests(*self._weights(taken)) + self._log_all_apart(taken)
        return float(self._kept[place]) + self._log_number([slot for slot, _ in taken], hidden)

    def log_densities(self, taken: Sequence[tuple[int, int]], slot: int, hidden: int) -> NDArray[np.float64]:
        """(K,) the same with one slot more, at each of its candidates."""
        place = tuple(taken), slot
        if place not in self._kept:
            log_apart = self._log_all_apart(taken) + self._log_apart_with(taken, slot)
            self._kept[place] = self._log_forests_with(taken, slot) + log_apart
        return self._kept[place] + self._log_number([slot, *(one for one, _ in taken)], hidden)

    @cached_property
    def _kept(self) -> dict[tuple[tuple[tuple[int, int], ...], int | None], NDArray[np.float64]]:
        """Log sums over graphs of what is taken, and with one slot more: moves come to the same again."""
        return {}

    def _log_forests_with(self, taken: Sequence[tuple[int, int]], slot: int) -> NDArray[np.float64]:
        """Log sums over graphs (K,) of what is taken and one slot more, at each of its candidates."""
        count = len(taken)
        root, others = self._weights(taken)
        candidates = self.on_root.shape[1]
        roots = np.empty((candidates, count + 1))
        roots[:, :count], roots[:, count] = root, self.on_root[slot]
        every = np.zeros((candidates, count + 1, count + 1))
        every[:, :count, :count] = others
        if taken:
            beside = np.stack([self.weights_beside(*one)[:, slot] for one in taken])
            every[:, count, :count], every[:, :count, count] = beside[:, 0].T, beside[:, 1].T
        return self._log_forests(roots, every)

    def _log_all_apart(self, taken: Sequence[tuple[int, int]]) -> float:
        """Log factor of all pairs of what is taken."""
        if len(taken) < 2:
            return 0.0
        *rest, (slot, place) = taken
        if tuple(taken) not in self._kept_apart:
            last = float(self._log_apart_with(rest, slot)[place])
            self._kept_apart[tuple(taken)] = self._log_all_apart(rest) + last
        return self._kept_apart[tuple(taken)]

    @cached_property
    def _kept_apart(self) -> dict[tuple[tuple[int, int], ...], float]:
        """Log factors of all pairs of what is taken: moves come to the same again."""
        return {}

    def _log_apart_with(self, taken: Sequence[tuple[int, int]], slot: int) -> NDArray[np.float64]:
        """Log factor (K,) of a slot's candidates beside what is taken."""
        total = np.zeros(self.on_root.shape[1])
        if self.log_apart is not None and slot < self.asked:
            for one in taken:
                if one[0] < self.asked:
                    total += self.log_apart(*one)[slot]
        return total

    def _weights(self, taken: Sequence[tuple[int, int]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """On the root (n,), and of each on each (n, n)."""
        if not taken:
            return np.zeros(0), np.zeros((0, 0))
        at = tuple(np.array(part, np.intp) for part in zip(*taken, strict=True))
        return self.on_root[at], np.stack([self.weights_beside(*one)[1][at] for one in taken])

    @staticmethod
    def _log_forests(on_root: NDArray[np.float64], on_others: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log sum over graphs (...) of weights (..., n) and (..., n, n)."""
        laplacian = -on_others
        diagonal = np.arange(on_root.shape[-1])
        laplacian[..., diagonal, diagonal] += on_root + on_others.sum(axis=-1)
        sign, log_sum = np.linalg.slogdet(laplacian)
        return np.where(sign > 0, log_sum, -np.inf)

    def _log_number(self, slots: Sequence[int], hidden: int) -> float:
        asked = sum(slot < self.asked for slot in slots) + hidden
        if asked >= len(self.log_sets):  # nothing else can be hidden
            return -np.inf
        return float(self.log_sets[asked] - self.log_trees[len(slots)])


def log_weighted_trees(floating_weight: float, supports: int, slots: int) -> NDArray[np.float64]:
    """`ForestPrior.log_trees` (slots + 1,) where what floats counts so much (Cayley's formula)."""
    free = np.arange(slots + 1)
    grounded = floating_weight + supports
    return np.where(free > 0, np.log(grounded) + (free - 1) * np.log(grounded + free), 0.0)
