"""How work is run: kernels compiled in the background, batches shared among threads, progress told.

JAX compiles a kernel once; whoever calls one that is being compiled waits for it. Threads must not differ in
`jax.enable_x64` meanwhile: JAX 0.10 then hands host arrays of one precision to kernels of the other.

A kernel's own threads meet after every operation, and its loops wait for them. Kernels that run in parallel,
each on its share of the batch, do not. Accelerators get the batch whole.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Protocol, TypeVar

import jax
import numpy as np
from numpy.typing import NDArray

FAST_COMPILE: dict[str, bool | int] = {"xla_backend_optimization_level": 1}
"""Compiler options of kernels that run for less time than they take to compile: half of that."""


if jax.__version_info__ < (0, 11, 1):  # newer ones refuse it, for their compiler has no other way
    FAST_COMPILE["xla_cpu_use_fusion_emitters"] = False


class Progress(Protocol):
    """Whom a stage tells how far it is."""

    def phase(self, name: str) -> None:
        """What is being done now, while nothing is counted."""

    def __call__(self, done: int, total: int | None = None) -> None:
        """How many units are done, of how many."""


@contextmanager
def compile_in_background(*kernels: Callable[[], object]) -> Iterator[None]:
    """Compile kernels, by calls that do so and in this order, on another core while the block runs."""
    with ThreadPoolExecutor(1) as beside:
        compiled = [beside.submit(kernel) for kernel in kernels]
        yield
    for kernel in compiled:
        kernel.result()


PER_SHARE = 64
"""Hypotheses of a share: as many as keep a core busy for some milliseconds, and a batch several cores."""

Batch = TypeVar("Batch")

Item = TypeVar("Item")

Done = TypeVar("Done")


def score_on_all_cores(
    score: Callable[[Batch], jax.Array], batch: Batch, per_share: int = PER_SHARE
) -> NDArray[np.float32]:
    """The scores (N,) of a batch, leaves (N, ...), one or more.

    Shares have one size, filled up by the last member, for one kernel to serve batches of any size. The
    number of cores changes no byte.
    """
    count = len(jax.tree.leaves(batch)[0])
    if jax.default_backend() != "cpu":
        return np.asarray(score(batch))
    batch = jax.tree.map(np.asarray, batch)

    def scored(first: int) -> NDArray[np.float32]:
        mine = np.minimum(np.arange(first, first + per_share), count - 1)
        return np.asarray(score(jax.tree.map(lambda leaf: leaf[mine], batch)))

    return np.concatenate(map_parallel(scored, range(0, count, per_share)))[:count]


def map_parallel(work: Callable[[Item], Done], items: Iterable[Item]) -> list[Done]:
    """What becomes of items, in their order, each worked on by one core."""
    with ThreadPoolExecutor(_cores()) as cores:
        return list(cores.map(work, items))


def _cores() -> int:
    """Those that this process may use: a worker has one."""
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
