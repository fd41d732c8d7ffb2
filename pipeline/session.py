"""One command at work on one recording: what it reads, what it was told, and the run folder it fills."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.config import plain_values
from pipeline.errors import PipelineError
from pipeline.fingerprints import file_hash, recording_hash, source_hash
from pipeline.logs import log
from pipeline.options import Common, RecordingSource
from pipeline.publishing.publish import publish
from pipeline.run_access import open_run_folder
from pipeline.run_folder import Committed, RunFolder, V
from pipeline.seeds import Stage, stage_key
from recordings.depth_statistics import DepthStatistics
from recordings.reading import McapRecording, open_recording
from recordings.types import Damage

if TYPE_CHECKING:
    import jax

READING_MODULE = "recordings.reading"
NUMBERED_BY = ("depth_topic", "intrinsics", "depth_scale_m", "start_s", "end_s", "every")
"""Settings of reading that decide which frame has which number, and where its points lie."""
NUMBERED = ("slam", "learn", "parse")
"""Stages that tell of frames by their numbers, or of places in the camera of the first one used."""


class Session:
    """What a stage needs to be wired up.

    Attributes:
        common: seed, settings, progress.
        source: the recording's path and the command's options of reading it.
        run: where values are committed.
        recording: the frames.
        warnings: what was to be said of them so far.
    """

    def __init__(
        self,
        common: Common,
        source: RecordingSource,
        run: RunFolder,
        recording: McapRecording,
        recording_hash: str,
    ) -> None:
        """Work on an open recording in a run folder that is held."""
        self.common = common
        self.source = source
        self.run = run
        self.recording = recording
        self._recording_hash = recording_hash
        self.warnings: list[str] = []
        self._statistics: DepthStatistics | None = None
        self._begun: set[str] = set()

    def key(self, stage: Stage) -> jax.Array:
        """The key of a stage."""
        return stage_key(self.common.seed, stage)

    def begin(self, *names: str) -> None:
        """Say which stages are about to be made: none may stand beside one that read other frames.

        Raises:
            PipelineError: the run holds one that did; with `force` that is removed instead.
        """
        self._begun |= set(names)
        here = plain_values(self.recording.options)
        for name, record in self.run.others(self._begun).items():
            there = record.settings.get("recording", here)
            differ = [key for key in NUMBERED_BY if there.get(key) != here.get(key)]
            if name.partition("/")[0] not in NUMBERED or not differ:
                continue
            if self.run.force:
                log.info("%s: removed, it read other frames", name)
                self.run.forget(name)
                continue
            told = ", ".join(f"{key} {there.get(key)} there, {here.get(key)} here" for key in differ)
            raise PipelineError(
                f"{self.run.path} holds {name} of other frames of the recording ({told}); read the same "
                "ones, name another folder with -o, or begin this one anew with --force"
            )

    def stage(
        self,
        name: str,
        load: Callable[[Path], V],
        compute: Callable[[], V],
        settings: Mapping[str, Any],
        inputs: Mapping[str, str] | None = None,
        *,
        uses: Sequence[Committed[Any]] = (),
        sources: tuple[str, ...] = (),
    ) -> Committed[V]:
        """A stage, computed only where the recording, the seed, settings, inputs or sources changed.

        Args:
            name: `sensor`, `slam`, `room`, `learn/NAME`, `objects` or `parse`.
            load: reads a value back.
            compute: makes the value.
            settings: the stage's configuration, by section of the settings file.
            inputs: hashes of what else it is made from.
            uses: the stages that it is made from.
            sources: modules that compute it.
        """
        options = self.recording.options
        files = {"mask": options.mask, "sensor": options.sensor}
        files = {file: path.resolve() for file, path in files.items() if path is not None}
        general = {"recording": replace(options, **files), "run": {"seed": self.common.seed}}
        made_from = {"recording": self._recording_hash, "sources": source_hash(READING_MODULE, *sources)}
        made_from |= {file: file_hash(path) for file, path in files.items()}
        committed = self.run.stage(
            name,
            load,
            self._prepared(compute),
            settings={**general, **settings},
            inputs={**made_from, **(inputs or {})},
            uses=uses,
            notes=lambda: {"damage": vars(self.recording.damage), "warnings": list(self.warnings)},
        )
        for sentence in committed.notes["warnings"]:
            self.warn(sentence)
        return committed

    def look(self) -> DepthStatistics:
        """What the recording's depths and stamps look like; says what about them can hardly be right.

        It is read once, and told with the stage that asked first.

        Raises:
            PipelineError: the options of reading leave no frame.
        """
        if self._statistics is None:
            self._statistics = self.recording.statistics()
        options = self.recording.options
        if not self._statistics.frames and (options.start_s > 0 or options.end_s < math.inf):
            raise PipelineError(f"{self.source.path}: no frame lies between --start and --end")
        for sentence in self._statistics.warnings(self.recording.size, self.recording.intrinsics):
            self.warn(sentence)
        return self._statistics

    def warn(self, sentence: str) -> None:
        """Say once what the user should know of the recording; it is kept with the stage that is at work."""
        if sentence not in self.warnings:
            self.warnings.append(sentence)
            log.warning("%s: %s", self.source.path, sentence)

    def _prepared(self, compute: Callable[[], V]) -> Callable[[], V]:
        """The same with JAX set up before it: a run with nothing to do never imports it."""

        def prepare_and_compute() -> V:
            from pipeline.jax_setup import set_up_jax

            set_up_jax()
            return compute()

        return prepare_and_compute

    @property
    def damage(self) -> Damage:
        """What was lost of the recording when the run's stages read it."""
        found = [Damage(**record.notes["damage"]) for record in self.run.records().values()]
        return Damage(
            lost_messages=max((one.lost_messages for one in found), default=0),
            lost_chunks=max((one.lost_chunks for one in found), default=0),
            verified=all(one.verified for one in found),
        )


@contextmanager
def open_session(
    common: Common, source: RecordingSource, run_path: Path, *, force: bool = False, replace: bool = False
) -> Iterator[Session]:
    """Open the recording and the run folder; when the block ends well, all derived files are written.

    Args:
        common: seed, settings, progress.
        source: the recording.
        run_path: the run folder.
        force: compute stages again.
        replace: begin the folder anew where it was made from another recording, as `force` does.

    Raises:
        RecordingError: the recording cannot be used.
        PipelineError: the run folder cannot be used, or a setting.
    """
    recording = open_recording(source.path, source.read_options(common.settings))
    made_from = recording_hash(source.path)
    with open_run_folder(run_path, {source.path.name: made_from}, force=force, replace=replace) as run:
        yield Session(common, source, run, recording, made_from)
        publish(run)
