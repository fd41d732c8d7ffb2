"""Runs a project: every recording through its stages, each in a run folder of its own, each for itself.

A recording that fails costs no other one. Shapes are learned before any is looked for; a recording that
looks for a shape by name fails where that could not be learned, one that looks for all takes what there is.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pipeline.atomic import atomic_path, write_json
from pipeline.errors import PipelineError
from pipeline.executors import executors_for
from pipeline.fingerprints import file_hash
from pipeline.logs import log, unforeseen
from pipeline.options import Common
from pipeline.progress import tell
from pipeline.project import Project, ProjectRecording, is_photograph, source_of
from pipeline.run_access import open_run_folder
from pipeline.session import open_session
from pipeline.stages.learn import learn_stage
from pipeline.stages.parse import parse_stage
from pipeline.stages.slam import slam_stage
from pipeline.task_engine import Outcome, Task, WorkerLost, run_tasks
from pipeline.timing import wall_clock
from recordings.errors import RecordingError
from recordings.types import Damage
from scene.copies import asked_copies


@dataclass(frozen=True, kw_only=True)
class Row:
    """How the work on one recording ended.

    Attributes:
        stem: of the recording.
        path: of the recording.
        stage: the last stage that was asked for.
        damage: what was lost of the recording, as far as is known.
        failure: why the stage could not be reached; None where it was.
        warnings: what was to be said on the way.
        seconds: that it took this time.
    """

    stem: str
    path: Path
    stage: str
    damage: Damage = field(default_factory=Damage)
    failure: str | None = None
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0


def run_project(
    project: Project,
    run: Path,
    common: Common,
    *,
    force: bool = False,
    workers: int | str | None = None,
    stop_at_failure: bool = False,
) -> list[Row]:
    """Fill a run folder with what a project asks for; what is there and unchanged is left as it is.

    Args:
        project: the recordings.
        run: the run folder.
        common: seed, settings, progress.
        force: compute everything again.
        workers: processes of one core each, side by side, or the address of a Dask scheduler; None works
            here, with all cores.
        stop_at_failure: begin no further recording once one has failed.

    Returns:
        How it ended for each recording, in the order of the work.

    Raises:
        PipelineError: the run folder cannot be used.
    """
    rows: dict[str, Row] = {}
    with open_run_folder(run, {"a project": "project"}, force=force):
        _forget_shapes(run, {one.shape for one in project.recordings if one.stage == "learn"})
        for stages in (("slam", "learn"), ("parse",)):
            chosen = [one for one in project.recordings if one.stage in stages]
            tasks = [_task(project, one, run, common, force=force, rows=rows) for one in chosen]
            for row in _rows(chosen, tasks, workers):
                rows[row.stem] = row
                _tell(row, len(rows), len(project.recordings), common)
                if stop_at_failure and row.failure:
                    break
            if stop_at_failure and any(row.failure for row in rows.values()):
                break
        ordered = [rows[one.stem] for one in project.recordings if one.stem in rows]
        _write_summary(run, ordered)
    return ordered


def recording_folder(run: Path, recording: ProjectRecording) -> Path:
    """The run folder of one recording of a project."""
    return run / "recordings" / recording.stem


def learned_shapes(run: Path) -> Path:
    """The folder of a project's run where its learned shapes are gathered."""
    return run / "shapes"


def run_recording(
    project: Project,
    recording: ProjectRecording,
    run: Path,
    common: Common,
    force: bool,
    warnings: Sequence[str],
) -> Row:
    """One recording through its stages; whatever is wrong with it is told in its row."""
    row = Row(stem=recording.stem, path=recording.path, stage=recording.stage, warnings=tuple(warnings))
    begun_s = wall_clock()
    try:
        damage, told = _run_stages(project, recording, run, common, force=force)
        row = replace(row, damage=damage, warnings=(*warnings, *told))
    except (RecordingError, PipelineError, OSError) as error:
        row = replace(row, failure=" ".join(str(error).split()))
    except Exception as error:  # of one recording among many; its traceback stands in its log.txt
        row = replace(row, failure=unforeseen(error))
    if row.failure and recording.stage == "learn":
        (learned_shapes(run) / f"{recording.shape}.npz").unlink(missing_ok=True)
    return replace(row, seconds=round(wall_clock() - begun_s, 1))


def _task(
    project: Project,
    recording: ProjectRecording,
    run: Path,
    common: Common,
    *,
    force: bool,
    rows: dict[str, Row],
) -> Task[Row]:
    """The work on one recording, told of the shapes that could not be learned before."""
    failed = {one.shape for one in project.recordings if one.stem in rows and rows[one.stem].failure}
    asked = {asked_copies(one)[0] for one in recording.objects or failed}
    missing = sorted(failed & asked) if recording.stage == "parse" else []
    if recording.shapes is not None:
        missing = []
    warnings = tuple(f"looked for all but {name}, which could not be learned" for name in missing)
    if missing and recording.objects is not None:
        refused = Row(
            stem=recording.stem,
            path=recording.path,
            stage=recording.stage,
            failure=f"the shape {missing[0]} could not be learned",
        )
        return Task(name=recording.stem, call=_as_it_is, arguments=(refused,))
    arguments = (project, recording, run, common, force, warnings)
    return Task(name=recording.stem, call=run_recording, arguments=arguments)


def _as_it_is(row: Row) -> Row:
    return row


def _rows(
    chosen: Sequence[ProjectRecording], tasks: Sequence[Task[Row]], workers: int | str | None
) -> Iterator[Row]:
    """The rows of tasks as they end: here one after the other, or on workers."""
    if workers is None:
        for task in tasks:
            yield task.call(*task.arguments)
        return
    by_name = {one.stem: one for one in chosen}
    quiet = [
        Task(name=one.name, call=one.call, arguments=tuple(_without_progress(a) for a in one.arguments))
        for one in tasks
    ]
    executors, at_once = executors_for(workers)
    for outcome in run_tasks(quiet, executors, at_once):
        yield outcome.result or _lost(by_name[outcome.task.name], outcome)


def _without_progress(argument: Any) -> Any:
    """Bars of several workers would write over one another."""
    return replace(argument, quiet=True) if isinstance(argument, Common) else argument


def _lost(recording: ProjectRecording, outcome: Outcome[Row]) -> Row:
    """The row of a recording that took its worker with it."""
    error = outcome.error
    why = str(error) if isinstance(error, WorkerLost) else f"{type(error).__name__}: {error}"
    return Row(stem=recording.stem, path=recording.path, stage=recording.stage, failure=why)


def _run_stages(
    project: Project, recording: ProjectRecording, run: Path, common: Common, *, force: bool
) -> tuple[Damage, list[str]]:
    settings = common.settings.over(recording.settings).over(project.settings)
    source = source_of(recording, settings)
    folder, own = recording_folder(run, recording), replace(common, settings=settings)
    with open_session(own, source, folder, force=force, replace=True) as session:
        if not is_photograph(recording, settings):
            slam_stage(session)
        if recording.stage == "learn":
            learn_stage(session, recording.shape)
        elif recording.stage == "parse":
            shapes = recording.shapes or learned_shapes(run)
            parse_stage(session, shapes, options={"objects": recording.objects})
    if recording.stage == "learn":
        _gather_shape(session.run.value_path(f"learn/{recording.shape}"), run)
    return session.damage, session.warnings


def _gather_shape(learned: Path, run: Path) -> None:
    """Put a learned shape among those of the project."""
    gathered = learned_shapes(run) / learned.name
    gathered.parent.mkdir(exist_ok=True)
    if not gathered.is_file() or file_hash(gathered) != file_hash(learned):
        with atomic_path(gathered) as partial:
            shutil.copyfile(learned, partial)


def _forget_shapes(run: Path, names: set[str]) -> None:
    """Take away what the project no longer learns."""
    for other in learned_shapes(run).glob("*.npz"):
        if other.stem not in names:
            other.unlink()


def _tell(row: Row, done: int, total: int, common: Common) -> None:
    """One line on stderr and in the log for a recording that has ended."""
    how = f"failed: {row.failure}" if row.failure else f"done in {row.seconds:.1f} s"
    log.info("[%d/%d] %s %s: %s", done, total, row.stage, row.path, how)
    if not common.quiet:
        tell(f"[{done}/{total}] {row.stage} {row.path}: {how}", err=True)


def _write_summary(run: Path, rows: Sequence[Row]) -> None:
    """What was found in each recording, by its stem, and why others failed."""
    failed = {row.stem: {"recording": str(row.path), "why": row.failure} for row in rows if row.failure}
    ended = [row for row in rows if not row.failure]
    for name in ("summary.json", "timing.json"):
        found = {row.stem: json.loads((run / "recordings" / row.stem / name).read_text()) for row in ended}
        content: dict[str, Any] = {"recordings": found}
        if name == "summary.json":
            content["failed"] = failed
        write_json(run / name, content)
