"""Kernels compiled beside other work: a first parse waits for its compiler more than for anything else.

JAX compiles a kernel once: whoever calls one that is being compiled waits for it. Threads must not differ in
`jax.enable_x64` meanwhile: JAX 0.10 then hands host arrays of one precision to kernels of the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import jax

SELDOM: dict[str, bool | int] = {"xla_backend_optimization_level": 1}
"""Compiler options of kernels that run for less time than they take to compile: half of that."""
if jax.__version_info__ < (0, 11, 1):  # newer ones refuse it, for their compiler has no other way
    SELDOM["xla_cpu_use_fusion_emitters"] = False


@contextmanager
def compiled_beside(*kernels: Callable[[], object]) -> Iterator[None]:
    """Compile kernels, by calls that do so and in this order, on another core while the block runs."""
    with ThreadPoolExecutor(1) as beside:
        compiled = [beside.submit(kernel) for kernel in kernels]
        yield
    for kernel in compiled:
        kernel.result()
