"""Runs a project: every recording through its stages, each in a run folder of its own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from pipeline.atomic import write_json
from pipeline.options import Common, Source
from pipeline.project import Project, ProjectRecording
from pipeline.run_folder import RunFolder
from pipeline.session import Session, open_session
from pipeline.stages.learn import learn_stage
from pipeline.stages.slam import slam_stage
from recordings.types import Damage


def run_project(
    project: Project, run: RunFolder, common: Common, *, force: bool = False
) -> dict[Path, Damage]:
    """Fill a run folder with what a project asks for; what is there and unchanged is left as it is.

    Returns:
        What was lost of each recording, by path.
    """
    common = replace(common, settings=common.settings.over(project.settings))
    damage = {}
    for number, recording in enumerate(project.recordings, start=1):
        if not common.quiet:
            click.echo(f"[{number}/{len(project.recordings)}] {recording.stage} {recording.path}", err=True)
        source = Source(path=recording.path, said=recording.reading)
        with open_session(common, source, recording_folder(run, recording), force=force) as session:
            _run_stages(session, recording)
        damage[recording.path] = session.damage
    for name in ("summary.json", "timing.json"):
        write_json(run.path / name, {"recordings": _gathered(project, run, name)})
    return damage


def recording_folder(run: RunFolder, recording: ProjectRecording) -> Path:
    """The run folder of one recording of a project."""
    return run.path / "recordings" / recording.stem


def _run_stages(session: Session, recording: ProjectRecording) -> None:
    slam_stage(session)
    if recording.stage == "learn":
        learn_stage(session, recording.shape)


def _gathered(project: Project, run: RunFolder, name: str) -> dict[str, Any]:
    """A JSON file of every recording's run, by the recording's stem."""
    return {
        one.stem: json.loads((recording_folder(run, one) / name).read_text()) for one in project.recordings
    }
