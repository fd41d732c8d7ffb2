"""Looking over a whole project before any of its work begins: every mistake that can be known, at once."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.options import Common
from pipeline.project import Project, ProjectRecording, source_of
from pipeline.shape_folder import shape_names
from recordings.errors import RecordingError
from recordings.reading import open_recording
from scene.config import ParseConfig
from scene.copies import asked_copies
from shapes.learning.config import LearnConfig
from slam.config import SlamConfig

ROOM_FOR_A_RECORDING = 32 << 20
"""Bytes that the results of a recording may take: the fused room's cloud and views, thrice, dominate."""


def project_mistakes(project: Project, run: Path, common: Common) -> list[str]:
    """A sentence on each thing that will not work: files, settings, names of shapes, room on the disk."""
    found = [line for one in project.recordings for line in _mistakes_of(project, one, common)]
    mistakes = list(dict.fromkeys(found))
    folder = next(one for one in (run, *run.absolute().parents) if one.exists())
    new = sum(not (run / "recordings" / one.stem).is_dir() for one in project.recordings)
    free, needed = shutil.disk_usage(folder).free, new * ROOM_FOR_A_RECORDING
    if free < needed:
        mistakes.append(f"{folder} has {free / 1e6:.0f} MB free, the project may need {needed / 1e6:.0f} MB")
    return mistakes


def _mistakes_of(project: Project, recording: ProjectRecording, common: Common) -> Iterator[str]:
    settings = common.settings.over(recording.settings).over(project.settings)
    sections: dict[str, Callable[[], object]] = {
        "slam": lambda: settings.section("slam", SlamConfig),
        "learn": lambda: settings.section("learn", LearnConfig),
        "parse": lambda: settings.section("parse", ParseConfig, {"objects": recording.objects}),
    }
    checks = [sections[name] for name in dict.fromkeys(("slam", recording.stage))]
    checks.append(
        lambda: open_recording(recording.path, source_of(recording, settings).read_options(settings))
    )
    if recording.stage == "parse":
        checks.append(lambda: _check_shapes(project, recording))
    for check in checks:
        try:
            check()
        except (RecordingError, PipelineError) as error:
            said = str(error)
            yield said if str(recording.path) in said else f"{recording.path}: {said}"


def _check_shapes(project: Project, recording: ProjectRecording) -> None:
    """Raise a PipelineError where the shapes to look for are not there, and nobody will learn them."""
    if recording.shapes is not None:
        known = shape_names(recording.shapes)
    else:
        known = sorted(one.shape for one in project.recordings if one.stage == "learn")
    asked = {asked_copies(one)[0] for one in recording.objects or ()}
    unknown = sorted(asked - set(known))
    if unknown:
        raise PipelineError(f"no shape {unknown[0]!r}; there are {', '.join(known)}")
