"""The one place that times work, with JAX's compile phase told apart."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass


def wall_clock() -> float:
    """Seconds since some moment, for differences."""
    return time.perf_counter()


def processor_clock() -> float:
    """Seconds of processor time of all threads, for differences: a busy machine does not change them."""
    return time.process_time()


def own_processor_clock() -> float:
    """The same of this thread alone."""
    return time.thread_time()


@contextmanager
def kernels_counted() -> Iterator[Callable[[], int]]:
    """A count of the kernels that have been compiled, or fetched from the persistent cache, in the block."""
    import jax

    count = 0

    def note(event: str, *_: float, **_named: float | str) -> None:
        nonlocal count
        count += event == "/jax/core/compile/backend_compile_duration"

    jax.monitoring.register_event_time_span_listener(note)
    try:
        yield lambda: count
    finally:
        jax.monitoring.unregister_event_time_span_listener(note)


@dataclass
class Timing:
    """How long a piece of work took; complete when it has ended.

    Attributes:
        seconds: without the compile phase.
        processor_s: processor time of all threads, less the length of the compile phase.
        compile_s: tracing, lowering and compiling, or fetching from the persistent cache.
    """

    seconds: float = 0.0
    processor_s: float = 0.0
    compile_s: float = 0.0


@contextmanager
def timed() -> Iterator[Timing]:
    """Time the block; overlapping compile events count once."""
    import jax

    spans: list[tuple[float, float]] = []

    def note(event: str, start_time: float, end_time: float, **_: str | int) -> None:
        if event.startswith("/jax/core/compile/"):
            spans.append((start_time, end_time))

    timing = Timing()
    jax.monitoring.register_event_time_span_listener(note)
    begun_s, begun_processor_s = wall_clock(), processor_clock()
    try:
        yield timing
    finally:
        elapsed_s, processor_s = wall_clock() - begun_s, processor_clock() - begun_processor_s
        jax.monitoring.unregister_event_time_span_listener(note)
        timing.compile_s = _covered_s(spans)
        timing.seconds = max(elapsed_s - timing.compile_s, 0.0)
        timing.processor_s = max(processor_s - timing.compile_s, 0.0)


def _covered_s(spans: list[tuple[float, float]]) -> float:
    """Length of the union of intervals."""
    covered_s, reached_s = 0.0, float("-inf")
    for start_s, end_s in sorted(spans):
        covered_s += max(end_s - max(start_s, reached_s), 0.0)
        reached_s = max(reached_s, end_s)
    return covered_s
