"""Runs a project: every recording through its stages, each in a run folder of its own."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from pipeline.atomic import atomic_path, write_json
from pipeline.options import Common, RecordingSource
from pipeline.project import Project, ProjectRecording
from pipeline.run_folder import file_hash, open_run_folder
from pipeline.session import open_session
from pipeline.stages.learn import learn_stage
from pipeline.stages.parse import parse_stage
from pipeline.stages.slam import slam_stage
from recordings.types import Damage


def run_project(project: Project, run: Path, common: Common, *, force: bool = False) -> dict[Path, Damage]:
    """Fill a run folder with what a project asks for; what is there and unchanged is left as it is.

    Returns:
        What was lost of each recording, by path.

    Raises:
        RecordingError: a recording cannot be used.
        PipelineError: the run folder cannot be used, or a stage found nothing to work on.
    """
    damage = {}
    with open_run_folder(run, {"a project": "project"}):
        for number, recording in enumerate(project.recordings, start=1):
            if not common.quiet:
                place = f"[{number}/{len(project.recordings)}]"
                click.echo(f"{place} {recording.stage} {recording.path}", err=True)
            damage[recording.path] = _run_recording(project, recording, run, common, force=force)
        for name in ("summary.json", "timing.json"):
            write_json(run / name, {"recordings": _gathered(project, run, name)})
    return damage


def recording_folder(run: Path, recording: ProjectRecording) -> Path:
    """The run folder of one recording of a project."""
    return run / "recordings" / recording.stem


def learned_shapes(run: Path) -> Path:
    """The folder of a project's run where its learned shapes are gathered."""
    return run / "shapes"


def _run_recording(
    project: Project, recording: ProjectRecording, run: Path, common: Common, *, force: bool
) -> Damage:
    settings = common.settings.over(recording.settings).over(project.settings)
    source = RecordingSource(path=recording.path, said=recording.reading)
    folder = recording_folder(run, recording)
    with open_session(replace(common, settings=settings), source, folder, force=force) as session:
        slam_stage(session)
        if recording.stage == "learn":
            learn_stage(session, recording.shape)
            _gather_shape(session.run.value_path(f"learn/{recording.shape}"), project, run)
        elif recording.stage == "parse":
            shapes = recording.shapes or learned_shapes(run)
            parse_stage(session, shapes, options={"objects": recording.objects})
    return session.damage


def _gather_shape(learned: Path, project: Project, run: Path) -> None:
    """Put a learned shape among those of the project, and take away what the project no longer learns."""
    folder = learned_shapes(run)
    folder.mkdir(exist_ok=True)
    if not (folder / learned.name).is_file() or file_hash(folder / learned.name) != file_hash(learned):
        with atomic_path(folder / learned.name) as partial:
            shutil.copyfile(learned, partial)
    names = {one.shape for one in project.recordings if one.stage == "learn"}
    for other in folder.glob("*.npz"):
        if other.stem not in names:
            other.unlink()


def _gathered(project: Project, run: Path, name: str) -> dict[str, Any]:
    """A JSON file of every recording's run, by the recording's stem."""
    return {
        one.stem: json.loads((recording_folder(run, one) / name).read_text()) for one in project.recordings
    }
