"""One command at work on one recording: what it reads, what it was told, and the run folder it fills."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pipeline.jax_setup import keep_compiled_kernels, trace_without_pauses
from pipeline.options import Common, RecordingSource
from pipeline.publishing.publish import publish
from pipeline.run_folder import RunFolder, V, file_hash, open_run_folder
from recordings.reading import McapRecording, open_recording
from recordings.types import Damage

if TYPE_CHECKING:
    import jax

Stage = Literal["slam", "learn", "parse", "draws"]
STAGES: tuple[Stage, ...] = ("slam", "learn", "parse", "draws")
"""In the order in which the root key is split; new stages go to the end."""


class Session:
    """What a stage needs to be wired up.

    Attributes:
        common: seed, settings, progress.
        source: the recording's path and the command's options of reading it.
        run: where values are committed.
        recording: the frames.
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

    def key(self, stage: Stage) -> jax.Array:
        """The key of a stage."""
        import jax

        return jax.random.split(jax.random.key(self.common.seed), len(STAGES))[STAGES.index(stage)]

    def stage(
        self,
        name: str,
        load: Callable[[Path], V],
        compute: Callable[[], V],
        settings: Mapping[str, Any],
        inputs: Mapping[str, str] | None = None,
    ) -> V:
        """A stage's value, computed only where the recording, the seed, settings or inputs changed.

        Args:
            name: `slam`, `learn/NAME` or `parse`.
            load: reads a value back.
            compute: makes the value.
            settings: the stage's configuration, by section of the settings file.
            inputs: hashes of what else it is made from: `run.fingerprint` of the stages that it uses.
        """
        general = {"recording": self.recording.options, "run": {"seed": self.common.seed}}
        return self.run.stage(
            name,
            load,
            compute,
            settings={**general, **settings},
            inputs={"recording": self._recording_hash, **(inputs or {})},
            notes=lambda: {"damage": vars(self.recording.damage)},
        )

    @property
    def damage(self) -> Damage:
        """What was lost of the recording when the run's stages read it."""
        records = [self.run.record(name) for name in self.run.stages()]
        found = [Damage(**record.notes["damage"]) for record in records if record]
        return Damage(
            lost_messages=max((one.lost_messages for one in found), default=0),
            lost_chunks=max((one.lost_chunks for one in found), default=0),
            verified=all(one.verified for one in found),
        )


@contextmanager
def open_session(
    common: Common, source: RecordingSource, run_path: Path, *, force: bool = False
) -> Iterator[Session]:
    """Open the recording and the run folder; when the block ends well, all derived files are written.

    Raises:
        RecordingError: the recording cannot be used.
        PipelineError: the run folder cannot be used, or a setting.
    """
    keep_compiled_kernels()
    trace_without_pauses()
    recording = open_recording(source.path, source.read_options(common.settings))
    recording_hash = file_hash(source.path)
    with open_run_folder(run_path, {source.path.name: recording_hash}, force=force) as run:
        yield Session(common, source, run, recording, recording_hash)
        publish(run)
