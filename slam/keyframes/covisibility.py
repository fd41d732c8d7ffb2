"""Which keyframes are held together by what they see: few overlaps lead from one to the other.

Others may be where they are by drift alone. They are no part of the map that a frame is compared with where
they contradict it, and seeing the same as they do is a loop.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

LEAST_HOPS = 4
"""Overlaps between two keyframes: nearer ones are held together."""


def held_together(count: int, overlaps: NDArray[np.integer]) -> scipy.sparse.csr_array:
    """Which keyframes (N, N) fewer than `LEAST_HOPS` overlaps (E, 2) lead to from one another."""
    step = _steps(count, overlaps)
    reached = step
    for _ in range(LEAST_HOPS - 2):
        reached = (reached @ step).astype(bool)
    return scipy.sparse.csr_array(reached)


def together_with(keyframe: int, count: int, overlaps: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Which keyframes (N,) are held together with that one."""
    step, reached = _steps(count, overlaps), np.arange(count) == keyframe
    for _ in range(LEAST_HOPS - 1):
        reached = step @ reached
    return reached


def _steps(count: int, overlaps: NDArray[np.integer]) -> scipy.sparse.csr_array:
    """(N, N) which keyframes overlap, each with itself, too."""
    ends = (overlaps[:, 0], overlaps[:, 1])
    overlap = scipy.sparse.coo_array((np.ones(len(overlaps)), ends), shape=(count, count)).tocsr()
    return scipy.sparse.csr_array((overlap + overlap.T + scipy.sparse.eye_array(count)).astype(bool))
