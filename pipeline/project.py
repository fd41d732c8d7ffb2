"""Projects: many recordings, all stages, one run folder.

    [run]
    seed = 0

    [slam]                     # settings of the stages, as in any settings file
    particles = 64

    [[recording]]
    path = "mug.mcap"          # relative to the project file
    stage = "learn"
    name = "mug"               # the file's stem unless given

    [[recording]]
    path = "table.mcap"
    stage = "parse"
    objects = ["mug", "can"]   # every learned shape unless given
    shapes = "meshes"          # a folder of shapes or meshes, instead of those that the project learns
    parse.presence = 0.5       # settings of the stages, for this recording alone

A recording may also have the settings of reading: depth_topic, every, start_s and so on. Each recording's
run stands in RUN/recordings/STEM; what was learned is gathered in RUN/shapes. `sensor` and `mask` name files
relative to the project file too, in a recording or, for all of them, above all tables.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pipeline.config import Settings, build, check_names, checked_sections, read_toml
from pipeline.errors import ConfigError, ProjectError
from pipeline.options import READING, RecordingSource
from scene.config import ParseConfig

FILE_NAME = r"\w[\w.-]{0,99}"
"""Names that are files' names too."""

Stage = Literal["slam", "learn", "parse"]
STAGES = ("slam", "learn", "parse")
OWN = ("path", "stage", "name", "objects", "shapes")
"""What a recording of a project has besides settings of reading and of the stages."""
ONE_STAGE = {"objects": "parse", "shapes": "parse", "parse": "parse", "learn": "learn"}
"""What only recordings of one stage have a use for."""
FILES = ("mask", "sensor")
"""Settings of reading that name files."""


@dataclass(frozen=True, kw_only=True)
class ProjectRecording:
    """One recording of a project and what is to be done with it.

    Attributes:
        path: the recording.
        stage: the last stage to run; those before it run too.
        name: of the learned shape; the recording's stem unless given.
        objects: shapes to look for; None takes all that there are.
        shapes: folder of shapes or meshes to look for; None takes what the project learns.
        reading: settings of reading, by name.
        settings: of the stages for this recording alone, by section.
    """

    path: Path
    stage: Stage
    name: str | None = None
    objects: tuple[str, ...] | None = None
    shapes: Path | None = None
    reading: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.name is not None and not re.fullmatch(FILE_NAME, self.name):
            raise ValueError("name must be up to 100 letters, digits, dots, dashes and underscores")
        if not self.stem:
            raise ValueError("path names no file of its own")

    @property
    def stem(self) -> str:
        """Name of its folder in the run."""
        return self.path.name.partition(".mcap")[0]

    @property
    def shape(self) -> str:
        """Name of the shape that is learned."""
        return self.name or self.stem


@dataclass(frozen=True, kw_only=True)
class Project:
    """What a project file says.

    Attributes:
        recordings: in the order of the work: shapes are learned before they are looked for.
        settings: of the stages, by section.
    """

    recordings: tuple[ProjectRecording, ...]
    settings: Mapping[str, Mapping[str, Any]]


class UnreadableEntries(ProjectError):  # noqa: N818  (an error by its base)
    """Recordings or settings of a project are not understood.

    Attributes:
        lines: why.
        rest: the project without them, and without what may depend on shapes that they were to learn.
    """

    def __init__(self, lines: Sequence[str], rest: Project) -> None:
        super().__init__(lines)
        self.lines = tuple(lines)
        self.rest = rest


def is_photograph(recording: ProjectRecording, settings: Settings) -> bool:
    """Whether objects are looked for in colour alone: neither depth nor the camera's path is needed.

    Raises:
        ConfigError: a setting of the stage cannot be used.
    """
    return recording.stage == "parse" and settings.section("parse", ParseConfig).colour == "only"


def source_of(recording: ProjectRecording, settings: Settings) -> RecordingSource:
    """What is read.

    Raises:
        ConfigError: a setting of the stage cannot be used.
    """
    source = RecordingSource(path=recording.path, said=recording.reading)
    return source.of_colour_alone if is_photograph(recording, settings) else source


def read_project(path: Path) -> Project:
    """Read a project file.

    Raises:
        UnreadableEntries: recordings or settings are not understood; the rest may tell what else is wrong.
        ConfigError: it cannot be read, or says what cannot be.
    """
    content = read_toml(path)
    entries = content.pop("recording", [])
    if not isinstance(entries, list) or not entries:
        raise ConfigError(f"{path} has no [[recording]]: each needs a path and a stage")
    for_all = {name: content.pop(name) for name in FILES if isinstance(content.get(name), str)}
    recordings, mistakes = _recordings(path, entries, for_all)
    settings: Mapping[str, Mapping[str, Any]] = {}
    try:
        settings = checked_sections(content, path)
    except ConfigError as error:
        mistakes.append(str(error))
    if mistakes:
        apart = [one for one in recordings if one.stage != "parse" or one.shapes is not None]
        raise UnreadableEntries(mistakes, Project(recordings=tuple(apart), settings=settings))
    for what, names, advice in (
        ("recordings", [one.stem for one in recordings], "give one of the files another name"),
        (
            "shapes",
            [one.shape for one in recordings if one.stage == "learn"],
            'give one another name with name = "..."',
        ),
    ):
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ConfigError(f"{path}: two {what} are named {twice[0]}; {advice}")
    if not any(one.stage == "learn" for one in recordings):
        without = [one.path for one in recordings if one.stage == "parse" and one.shapes is None]
        if without:
            raise ConfigError(
                f"{path}: nothing is learned that {without[0]} could be parsed with; "
                'add a recording with stage = "learn", or name a folder of shapes with shapes = "DIR"'
            )
    return Project(
        recordings=tuple(sorted(recordings, key=lambda one: one.stage == "parse")),
        settings=settings,
    )


def _recordings(
    path: Path, entries: list[Any], for_all: Mapping[str, str]
) -> tuple[list[ProjectRecording], list[str]]:
    """The recordings that the entries name, a pattern as many as it matches; and what is not understood.

    `for_all` holds where an entry says nothing.
    """
    found: list[ProjectRecording] = []
    mistakes: list[str] = []
    for number, entry in enumerate(entries, start=1):
        try:
            one = _recording(path, number, {**for_all, **entry} if isinstance(entry, Mapping) else entry)
            found += _matching(path.parent, one)
        except ConfigError as error:
            mistakes.append(str(error))
    return found, mistakes


def _matching(folder: Path, recording: ProjectRecording) -> list[ProjectRecording]:
    """One recording for every file that a path with * or ? matches, in the order of their names."""
    beside = recording.path.is_relative_to(folder)
    above = folder if beside else Path(recording.path.anchor)
    pattern = str(recording.path.relative_to(above))
    if not any(sign in pattern for sign in "*?"):
        return [recording]
    matches = sorted(above.glob(pattern))
    if not matches or recording.name is not None:
        why = "names several recordings, and name only one shape" if matches else "matches no file"
        raise ConfigError(f"{recording.path}: {why}")
    return [replace(recording, path=match) for match in matches]


def _beside(path: Path, reading: Mapping[str, Any]) -> dict[str, str]:
    """The files among the settings of reading, relative to the project file."""
    named = {name: reading[name] for name in FILES if isinstance(reading.get(name), str)}
    return {name: str(path.parent / value) for name, value in named.items()}


def _recording(path: Path, number: int, entry: Mapping[str, Any]) -> ProjectRecording:
    where = f"{path}, recording {number}"
    if not isinstance(entry, Mapping):
        raise ConfigError(f"{where} is no table; write [[recording]] above its lines")
    check_names(entry, (*OWN, *READING, *STAGES), where)
    reading = {name: value for name, value in entry.items() if name in READING}
    reading |= _beside(path, reading)
    settings = {name: value for name, value in entry.items() if name in STAGES}
    own = {name: value for name, value in entry.items() if name in OWN}
    recording = build(ProjectRecording, {**own, "reading": reading, "settings": settings}, where)
    for name, stage in ONE_STAGE.items():
        if name in entry and recording.stage != stage:
            raise ConfigError(f"{where}: {name} is for stage = {stage!r}, not {recording.stage!r}")
    shapes = None if recording.shapes is None else path.parent / recording.shapes
    return replace(recording, path=path.parent / recording.path, shapes=shapes)
