"""Independent tasks on any executor: failures become outcomes, killed workers are replaced.

A task is a call of an importable function with arguments that can be pickled: numbers, paths and settings,
never arrays. `local_processes` gives spawned workers of this machine, one core each; any other
`concurrent.futures.Executor`, such as that of a Dask client, serves as well.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

Result = TypeVar("Result")
Executors = Callable[[], AbstractContextManager[Executor]]
"""Gives a new executor whenever the last one broke."""

MOST_TRIES = 3
"""Workers that one task may lose before it counts as failed."""


@dataclass(frozen=True, kw_only=True)
class Task(Generic[Result]):
    """One call.

    Attributes:
        name: what it is called in tables.
        call: an importable function.
        arguments: its arguments.
    """

    name: str
    call: Callable[..., Result]
    arguments: tuple[Any, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Outcome(Generic[Result]):
    """How a task ended: with a result, or with the error that says why not."""

    task: Task[Result]
    result: Result | None = None
    error: BaseException | None = None


class WorkerLost(Exception):  # noqa: N818  (an outcome, not a mistake of the caller)
    """A task's worker died each time that it was tried, killed from outside or for memory."""


def run_tasks(tasks: Sequence[Task[Result]], executors: Executors, at_once: int) -> Iterator[Outcome[Result]]:
    """Every task's outcome, in the order in which they end.

    The standard pool gives up when one of its workers is killed, and does not say which task it had. So no
    more tasks are handed over than there are workers, each that was under way counts a try, and is tried
    again alone: a task that kills its workers fails alone.

    Args:
        tasks: what is to be done.
        executors: makes an executor.
        at_once: tasks that are handed over at a time: the number of workers.
    """
    tries = dict.fromkeys(range(len(tasks)), 0)
    fresh, suspects = deque(range(len(tasks))), deque[int]()
    while fresh or suspects:
        alone = bool(suspects)
        waiting, limit = (deque([suspects.popleft()]), 1) if alone else (fresh, at_once)
        with executors() as executor:
            for number, outcome in _until_broken(tasks, waiting, executor, limit):
                if not isinstance(outcome.error, BrokenExecutor):
                    yield outcome
                    continue
                tries[number] += 1
                if tries[number] < MOST_TRIES:
                    suspects.append(number)
                    continue
                why = f"its worker was killed {MOST_TRIES} times; is there memory enough?"
                yield Outcome(task=tasks[number], error=WorkerLost(why))


def _until_broken(
    tasks: Sequence[Task[Result]], waiting: deque[int], executor: Executor, limit: int
) -> Iterator[tuple[int, Outcome[Result]]]:
    """Number and outcome of each task of `waiting` that `executor` ends, or loses when it breaks."""
    running: dict[Future[Result], int] = {}
    broken = False
    while running or (waiting and not broken):
        while waiting and len(running) < limit and not broken:
            task = tasks[waiting[0]]
            try:
                running[executor.submit(task.call, *task.arguments)] = waiting[0]
            except BrokenExecutor:
                broken = True
                break
            waiting.popleft()
        if not running:
            break
        ended, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in sorted(ended, key=running.__getitem__):
            number = running.pop(future)
            error = future.exception()
            broken |= isinstance(error, BrokenExecutor)
            result = None if error is not None else future.result()
            yield number, Outcome(task=tasks[number], result=result, error=error)


@contextmanager
def local_processes(count: int) -> Iterator[Executor]:
    """Spawned worker processes, one core each; none outlives the block or this process."""
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    executor = ProcessPoolExecutor(
        count, mp_context=context, initializer=_become_worker, initargs=(context.Value("i", 0),)
    )
    try:
        yield executor
    except BaseException:
        for child in set(multiprocessing.active_children()) - others:
            child.kill()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def local_workers(count: int) -> Executors:
    """So many local processes, whenever they are asked for."""
    return partial(local_processes, count)


def _become_worker(numbers: Any) -> None:
    """Take a core of one's own, leave interrupts to the parent, and end with it, however it ends."""
    with numbers.get_lock():
        number = numbers.value
        numbers.value += 1
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[number % len(cores)]})
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
