"""Batches of hypotheses shared among the processor's cores.

A kernel's own threads meet after every operation, and its loops wait for them; kernels that run side by side,
each on its share of the batch, do not. Accelerators get the batch whole.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import jax
import numpy as np
from numpy.typing import NDArray

LEAST = 64
"""Hypotheses of a share."""

Batch = TypeVar("Batch")
Item = TypeVar("Item")
Done = TypeVar("Done")


def shared_among_cores(score: Callable[[Batch], jax.Array], batch: Batch) -> NDArray[np.float32]:
    """The scores (N,) of a batch, leaves (N, ...); shares have one size, for one kernel to serve them all."""
    count = len(jax.tree.leaves(batch)[0])
    shares = max(min(_cores(), count // LEAST), 1)
    if shares == 1:
        return np.asarray(score(batch))
    length = -(-count // shares)
    batch = jax.tree.map(np.asarray, batch)

    def scored(share: int) -> NDArray[np.float32]:
        mine = np.minimum(np.arange(share * length, (share + 1) * length), count - 1)
        return np.asarray(score(jax.tree.map(lambda leaf: leaf[mine], batch)))

    return np.concatenate(side_by_side(scored, range(shares)))[:count]


def side_by_side(work: Callable[[Item], Done], items: Iterable[Item]) -> list[Done]:
    """What becomes of items, in their order, each worked on by one core."""
    with ThreadPoolExecutor(_cores()) as cores:
        return list(cores.map(work, items))


def _cores() -> int:
    return (os.cpu_count() or 1) if jax.default_backend() == "cpu" else 1
