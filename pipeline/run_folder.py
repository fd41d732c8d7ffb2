"""The run folder: values of finished stages, each committed whole, and what is derived from them.

A stage is committed in two steps: its value is written under its final name, then a record of what it was
made from; one that fails leaves what was committed before. Only a value with a record counts, and a value
that was just made is read back before anything is derived from it; so a run that was killed at any moment and
started again ends with the same files as one that was not. A record holds a hash of the program's sources
too: another program computes again.

    RUN/stages/inputs.json      what the folder was made from
    RUN/stages/STAGE.json       fingerprint, hash of the value, seconds, machine
    RUN/slam.npz, room.npz, objects.npz, parse.npz, shapes/NAME.npz, stages/sensor.toml      the values
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from pipeline.atomic import write_json
from pipeline.config import build, plain_values
from pipeline.errors import PipelineError
from pipeline.fingerprints import canonical_hash, file_hash
from pipeline.logs import log
from pipeline.machine import machine
from recordings.options import ReadOptions

FORMAT = 4
"""Raised whenever a stage's value would differ for the same inputs, settings and sources."""


INPUTS = Path("stages", "inputs.json")
"""Within a run folder: what it was made from."""


def holds_stages(folder: Path) -> bool:
    """Whether a folder is a run folder, of one recording or of a project."""
    return (folder / INPUTS.parent).is_dir()


def is_project(folder: Path) -> bool:
    """Whether a folder is the run of a project."""
    return holds_stages(folder) and (folder / "recordings").is_dir()


def check_one_recording(run: Path) -> None:
    """Refuse the run of a project where that of one recording is asked for.

    Raises:
        PipelineError: it names what to take instead.
    """
    if is_project(run):
        names = ", ".join(sorted(one.name for one in (run / "recordings").iterdir()))
        raise PipelineError(f"{run} is the run of a project; name {run}/recordings/STEM, of {names}")


def read_inputs(path: Path) -> dict[str, str] | None:
    """What a run folder was made from; None where it is new or was cut off before it was known."""
    try:
        return dict(json.loads((path / INPUTS).read_text()))
    except (OSError, ValueError, TypeError):
        return None


class Value(Protocol):
    """The result of a stage."""

    def save(self, path: Path) -> None:
        """Write it to one file, the same bytes for the same value."""
        ...


V = TypeVar("V", bound=Value)


@dataclass(frozen=True, kw_only=True)
class StageRecord:
    """What is known of a committed stage.

    Attributes:
        fingerprint: hash of everything that the value depends on.
        value_hash: SHA-256 of the value's file.
        settings: the settings it was computed with, by section, as plain values.
        uses: fingerprints of the stages that it was made from, by name.
        notes: what else was to be remembered.
        machine: cores, processor and versions it was computed with.
        seconds: time to compute it, without compiling.
        compile_s: time in JAX's compile phase.
    """

    fingerprint: str
    value_hash: str
    settings: Mapping[str, Any]
    uses: Mapping[str, str]
    notes: Mapping[str, Any]
    machine: Mapping[str, Any]
    seconds: float
    compile_s: float

    @property
    def read_options(self) -> ReadOptions:
        """How it read its recording."""
        return build(ReadOptions, self.settings.get("recording", {}), "recording")


class Committed(Generic[V]):
    """A committed stage, whose value is read where it is asked for.

    Attributes:
        name: of the stage.
        fingerprint: hash of everything that the value was made from.
        notes: what else was remembered.
    """

    def __init__(self, name: str, record: StageRecord, path: Path, load: Callable[[Path], V]) -> None:
        """The stage `name`, whose value `load` reads from `path`."""
        self.name = name
        self.fingerprint = record.fingerprint
        self.notes = record.notes
        self._path, self._load = path, load

    @cached_property
    def value(self) -> V:
        """What was computed, as it was written."""
        return self._load(self._path)


class RunFolder:
    """One run folder, held by one process at a time; opened by `pipeline.run_access`.

    Attributes:
        path: the folder.
        force: compute stages again.
        checkpoint_path: where the stage that is computed now may keep how far it came; it is found there
            again by the same stage made from the same things, and removed when that is committed.
    """

    def __init__(self, path: Path, *, force: bool = False) -> None:
        """Use `path`; `force` computes stages again."""
        self.path = path
        self.force = force
        self.checkpoint_path: Path | None = None
        self._told: set[str] = set()

    def stage(
        self,
        name: str,
        load: Callable[[Path], V],
        compute: Callable[[], V],
        *,
        settings: Mapping[str, Any],
        inputs: Mapping[str, str],
        uses: Sequence[Committed[Any]] = (),
        notes: Callable[[], Mapping[str, Any]] = dict,
    ) -> Committed[V]:
        """A stage, computed only where no committed value was made from the same things.

        Args:
            name: `sensor`, `slam`, `room`, `learn/NAME`, `objects` or `parse`.
            load: reads a value back.
            compute: makes the value.
            settings: configuration dataclasses and plain values, by section of the settings file; of files
                that they name the hashes count, among the inputs, and not the paths.
            inputs: hashes of what it is made from, by name: files, and the sources that compute it.
            uses: the stages that it is made from.
            notes: what else the record is to say, asked for when the value has been computed.

        Raises:
            PipelineError: the value cannot be written.
        """
        used = {one.name: one.fingerprint for one in uses}
        made_from = {"stage": name, "format": FORMAT, "inputs": inputs, "uses": used}
        fingerprint = canonical_hash({**made_from, "settings": plain_values(settings, paths=False)})
        record = self.record(name)
        if self.force or record is None or record.fingerprint != fingerprint:
            if record is not None and not self.force:
                self._tell_difference(name, record.settings, plain_values(settings))
            self._expect_checkpoint(name, fingerprint)
            seconds, compile_s = self._compute(name, compute)
            record = StageRecord(
                fingerprint=fingerprint,
                value_hash=file_hash(self.value_path(name)),
                settings=plain_values(settings),
                uses=used,
                notes=dict(notes()),
                machine=machine(),
                seconds=seconds,
                compile_s=compile_s,
            )
            self._record_path(name).parent.mkdir(parents=True, exist_ok=True)
            write_json(self._record_path(name), vars(record))
            self._expect_checkpoint(name, None)
            self._tell_other_cores(record)
        else:
            log.info("%s: unchanged", name)
        return Committed(name, record, self.value_path(name), load)

    def record(self, name: str) -> StageRecord | None:
        """The record of a committed stage whose value is still the one that was committed."""
        with suppress(OSError, ValueError, TypeError):
            record = StageRecord(**json.loads(self._record_path(name).read_text()))
            if file_hash(self.value_path(name)) == record.value_hash:
                return record
        return None

    def records(self) -> dict[str, StageRecord]:
        """Records by stage, in the order of the work; without those made from a stage that is another now."""
        found = {name: record for name in self._stages() if (record := self.record(name))}
        return {
            name: record
            for name, record in found.items()
            if all(used in found and found[used].fingerprint == made for used, made in record.uses.items())
        }

    def others(self, names: Collection[str]) -> dict[str, StageRecord]:
        """Records of the stages that stay when those of these names are made anew: none is made from them."""
        anew, found = set(names), self.records()
        for name, record in found.items():
            if anew & set(record.uses):
                anew.add(name)
        return {name: record for name, record in found.items() if name not in anew}

    def forget(self, name: str) -> None:
        """Remove a stage, its record first."""
        self._record_path(name).unlink(missing_ok=True)
        self.value_path(name).unlink(missing_ok=True)

    @property
    def made_from(self) -> dict[str, str]:
        """Hashes of what the folder was made from, by file name; nothing where it does not say so."""
        return read_inputs(self.path) or {}

    @property
    def changed(self) -> list[str]:
        """A sentence on each stage whose value is not what was committed: damaged, changed, or older."""
        return [
            f"{self.value_path(name).relative_to(self.path)} was changed or is of another version; "
            "it is left out, and the command that made it makes it anew"
            for name in self._stages()
            if self._record_path(name).is_file() and self.record(name) is None
        ]

    @property
    def identity(self) -> str:
        """Eight letters that differ where what the folder was made from, or its place, differs."""
        made_from = {name: record.fingerprint for name, record in self.records().items()}
        return canonical_hash({"place": str(self.path.resolve()), **made_from})[:8]

    def value_path(self, name: str) -> Path:
        """Where a stage's value is kept; the run's own sensor.toml is what all stages know together."""
        if name == "sensor":
            return self.path / "stages" / "sensor.toml"
        kind, _, shape = name.partition("/")
        return self.path / "shapes" / f"{shape}.npz" if kind == "learn" else self.path / f"{kind}.npz"

    def _stages(self) -> list[str]:
        """Names of the stages that a run may have, in the order of the work."""
        shapes = sorted((self.path / "stages" / "learn").glob("*.json"))
        return ["sensor", "slam", "room", *(f"learn/{path.stem}" for path in shapes), "objects", "parse"]

    def _expect_checkpoint(self, name: str, fingerprint: str | None) -> None:
        """Let a stage have the checkpoint of a fingerprint, or none; those made from other things go."""
        folder, stem = self.path / "stages", name.replace("/", ".")
        self.checkpoint_path = folder / f"{stem}.{fingerprint}.checkpoint" if fingerprint else None
        for other in folder.glob(f"{stem}.*.checkpoint*"):
            if (
                self.force
                or self.checkpoint_path is None
                or not other.name.startswith(self.checkpoint_path.name)
            ):
                other.unlink()

    def _compute(self, name: str, compute: Callable[[], V]) -> tuple[float, float]:
        """Compute a value and write it; seconds, and those of compiling."""
        from pipeline.quiet_stdout import stdout_to_stderr
        from pipeline.timing import timed

        path = self.value_path(name)
        log.info("%s: computing", name)
        with timed() as timing, stdout_to_stderr():
            value = compute()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._record_path(name).unlink(missing_ok=True)
        try:
            value.save(path)
        except OSError as error:
            raise PipelineError(f"cannot write {path}: {error.strerror or error}") from error
        return round(timing.seconds, 6), round(timing.compile_s, 6)

    def _tell_difference(self, stage: str, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
        """Say once which settings are others than those that a stage was made with, if any are."""
        one, other = _by_name(before), _by_name(now)
        differ = [name for name in sorted({*one, *other}) if one.get(name) != other.get(name)]
        told = ", ".join(f"{name} was {one.get(name, 'not set')}" for name in differ)
        if told and told not in self._told:
            log.warning("%s is made again: %s", stage, told)
        self._told.add(told)

    def _tell_other_cores(self, record: StageRecord) -> None:
        """Say where a run goes on with other cores or versions, for its last bits are a mixture then."""
        for used in record.uses:
            other = self.record(used)
            for what in ("cores", "processor", "versions"):
                if other and other.machine.get(what) != record.machine[what]:
                    log.warning(
                        "%s was computed with %s %s, what is made from it now with %s: bits may differ",
                        *(used, what, other.machine.get(what), record.machine[what]),
                    )

    def _record_path(self, name: str) -> Path:
        return self.path / "stages" / f"{name}.json"


def _by_name(settings: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Settings of nested tables as SECTION.KEY."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        name = f"{above}{key}"
        found |= _by_name(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return found
