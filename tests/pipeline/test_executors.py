"""Where tasks run changes nothing of what they give."""

from pathlib import Path

import click
import pytest

from pipeline.benchmarks.pose_sources import Tables
from pipeline.benchmarks.poses import judged_images
from pipeline.errors import PipelineError
from pipeline.executors import Workers, executors_for
from pipeline.mesh_source import MeshSource
from pipeline.task_engine import Task, run_tasks
from tests.pipeline.benchmarks.test_poses import Truthful

TABLES = Tables(shapes=MeshSource(names=("bracket", "mug")), objects=2, seed=1, numbers=(0, 1, 2))


def rows(workers: int | str, folder: Path) -> dict[str, bytes]:
    """The files of rows that workers make."""
    executors, at_once = executors_for(workers)
    list(judged_images(TABLES, [Truthful()], executors, at_once, folder))
    return {path.name: path.read_bytes() for path in (folder / "rows").rglob("*.json")}


@pytest.mark.parametrize(("text", "workers"), [("1", 1), ("12", 12), ("tcp://a:8786", "tcp://a:8786")])
def test_workers_are_a_number_or_an_address(text: str, workers: int | str) -> None:
    """As the option takes them."""
    assert Workers().convert(text, None, None) == workers


@pytest.mark.parametrize("text", ["0", "-1", "many", "http://a"])
def test_other_workers_are_refused(text: str) -> None:
    """With a word on what is wanted."""
    with pytest.raises(click.BadParameter, match="number of processes"):
        Workers().convert(text, None, None)


def test_this_process_tells_errors_as_any_executor() -> None:
    """In the outcome, not by raising."""
    executors, at_once = executors_for(1)
    wrong, right = run_tasks(
        [Task(name="wrong", call=int, arguments=("x",)), Task(name="right", call=int, arguments=("2",))],
        executors,
        at_once,
    )
    assert isinstance(wrong.error, ValueError)
    assert right.result == 2


def test_a_scheduler_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """In one line, after as long as it is waited for."""
    pytest.importorskip("distributed")
    monkeypatch.setattr("pipeline.executors.CLUSTER_ANSWERS_S", 0.2)
    with pytest.raises(PipelineError, match="no scheduler answers at tcp://127"):
        executors_for("tcp://127.0.0.1:1")


@pytest.mark.slow
def test_processes_and_a_cluster_make_the_same_rows(tmp_path: Path) -> None:
    """Two spawned processes and a Dask cluster of two, beside this process: the same bytes."""
    distributed = pytest.importorskip("distributed")
    alone = rows(1, tmp_path / "one")
    assert len(alone) == 3
    assert rows(2, tmp_path / "two") == alone
    cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    try:
        assert rows(cluster.scheduler_address, tmp_path / "dask") == alone
    finally:
        cluster.close()
