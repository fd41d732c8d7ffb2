"""Where tasks run: in this process, in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from functools import partial
from typing import Any

import click

from pipeline.errors import PipelineError
from pipeline.task_engine import Executors, local_workers

CLUSTER_ANSWERS_S = 10
"""A scheduler that does not answer sooner is not there."""
RETRIES = 2
"""Of a task whose worker is lost on a cluster."""
SAME_VERSIONS = ("python", "voxscene", "jax", "jaxlib", "numpy", "scipy")
"""Which decide the bits of a result, and so must be alike on all workers."""


class Workers(click.ParamType):
    """A number of processes of this machine, or the address of a Dask scheduler."""

    name = "N|tcp://HOST:PORT"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | str:
        """The number or the address."""
        text = str(value)
        if text.startswith(("tcp://", "tls://")):
            return text
        if text.isdecimal() and int(text) > 0:
            return int(text)
        return self.fail(f"{value!r} is neither a number of processes nor tcp://HOST:PORT", param, ctx)


class _ThisProcess(Executor):
    """Runs each call when it is handed over."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # the caller finds it in the future, as with any executor
            future.set_exception(error)
        return future


def executors_for(workers: int | str) -> tuple[Executors, int]:
    """What makes an executor, and how many tasks it does at once.

    Args:
        workers: 1 for this process, more for so many spawned ones, an address for a cluster.

    Raises:
        PipelineError: the cluster does not answer, runs other versions, or Dask is not installed.
    """
    if isinstance(workers, int):
        return (_this_process, 1) if workers == 1 else (local_workers(workers), workers)
    with _client(workers) as client:
        _check_versions(client, workers)
        threads = sum(client.nthreads().values())
    if not threads:
        raise PipelineError(f"the scheduler {workers} has no workers; start some with: dask worker {workers}")
    return partial(_cluster, workers), threads


@contextmanager
def _this_process() -> Iterator[Executor]:
    yield _ThisProcess()


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    with _client(address) as client, client.get_executor(retries=RETRIES, pure=False) as executor:
        yield executor


def _client(address: str) -> Any:
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise PipelineError(
            "a cluster needs Dask; install it with: pip install 'voxscene[cluster]'"
        ) from error
    try:
        return Client(address, timeout=CLUSTER_ANSWERS_S, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise PipelineError(f"no scheduler answers at {address} within {CLUSTER_ANSWERS_S} s") from error


def _check_versions(client: Any, address: str) -> None:
    own = _versions()
    for worker, found in client.run(_versions).items():
        for package in SAME_VERSIONS:
            if found.get(package) != own.get(package):
                raise PipelineError(
                    f"worker {worker} of {address} runs {package} {found.get(package)} where this machine"
                    f" runs {own.get(package)}: install the same versions"
                )


def _versions() -> dict[str, str]:
    from pipeline.machine import versions

    return versions()
