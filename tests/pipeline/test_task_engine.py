"""Tasks on workers: errors are outcomes, a killed worker costs a try, results depend on neither."""

import os
import signal
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from pipeline.task_engine import MOST_TRIES, Outcome, Task, WorkerLost, local_workers, run_tasks


def square(number: int) -> int:
    """A task that cannot fail."""
    return number * number


def refuse(number: int) -> int:
    """A task that fails."""
    raise ValueError(f"not {number}")


def die(marker: Path, times: int) -> int:
    """A task whose worker is killed so many times."""
    died = len(list(marker.iterdir()))
    if died < times:
        (marker / str(died)).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return died


def cores() -> int:
    """How many cores the worker may use."""
    return len(os.sched_getaffinity(0))


def results(outcomes: list[Outcome[int]]) -> dict[str, int | str | None]:
    """Result or error by name."""
    return {one.task.name: one.result if one.error is None else str(one.error) for one in outcomes}


def test_any_executor_serves_and_errors_are_outcomes() -> None:
    """Every task has one."""
    tasks = [Task(name=str(n), call=square if n % 3 else refuse, arguments=(n,)) for n in range(7)]
    found = results(list(run_tasks(tasks, partial(ThreadPoolExecutor, 2), 2)))

    assert found == {str(n): n * n if n % 3 else f"not {n}" for n in range(7)}


def test_a_killed_worker_costs_a_try_and_no_neighbour_fails(tmp_path: Path) -> None:
    """Once: done at the second try. Always: failed after three, alone.

    Its first try counts also where the other's death broke their pool before it began.
    """
    once, always = tmp_path / "once", tmp_path / "always"
    once.mkdir()
    always.mkdir()
    tasks = [
        Task(name="once", call=die, arguments=(once, 1)),
        Task(name="always", call=die, arguments=(always, 99)),
        *(Task(name=str(n), call=square, arguments=(n,)) for n in range(4)),
    ]
    outcomes = list(run_tasks(tasks, local_workers(2), 2))
    lost = [one for one in outcomes if isinstance(one.error, WorkerLost)]

    assert len(outcomes) == len(tasks)
    assert [one.task.name for one in lost] == ["always"]
    assert len(list(always.iterdir())) in (MOST_TRIES - 1, MOST_TRIES)
    assert {n: results(outcomes)[n] for n in ("once", "0", "1", "2", "3")} == {
        **{str(n): n * n for n in range(4)},
        "once": 1,
    }


def test_a_worker_has_one_core() -> None:
    """So that the number of workers changes no byte."""
    tasks = [Task(name=str(n), call=cores) for n in range(2)]

    assert set(results(list(run_tasks(tasks, local_workers(2), 2))).values()) == {1}
