"""The run folder: values of finished stages, each committed whole, and what is derived from them.

A stage is committed in two steps: its value is written under its final name, then a record of what it was
made from. Only a value with a record counts, and a value that was just made is read back before anything
is derived from it; so a run that was killed at any moment and started again ends with the same files as
one that was not.

    RUN/stages/inputs.json      what the folder was made from
    RUN/stages/STAGE.json       fingerprint, hash of the value, seconds
    RUN/slam.npz, shapes/NAME.npz, parse.npz        the values
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

from pipeline.atomic import write_json
from pipeline.config import plain_values
from pipeline.errors import PipelineError
from pipeline.quiet_stdout import stdout_to_stderr
from pipeline.timing import timed

log = logging.getLogger("voxscene")
log.setLevel(logging.INFO)

FORMAT = 2
"""Raised whenever a stage's value would differ for the same inputs and settings."""


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
        notes: what else was to be remembered.
        seconds: time to compute it, without compiling.
        compile_s: time in JAX's compile phase.
    """

    fingerprint: str
    value_hash: str
    settings: Mapping[str, Any]
    notes: Mapping[str, Any]
    seconds: float
    compile_s: float


class RunFolder:
    """One run folder, held by one process at a time; made by `open_run_folder`.

    Attributes:
        path: the folder.
    """

    def __init__(self, path: Path, *, force: bool) -> None:
        """Use `path`; `force` computes stages again."""
        self.path = path
        self._force = force

    def stage(
        self,
        name: str,
        load: Callable[[Path], V],
        compute: Callable[[], V],
        *,
        settings: Mapping[str, Any],
        inputs: Mapping[str, str],
        notes: Callable[[], Mapping[str, Any]] = dict,
    ) -> V:
        """The value of a stage, computed only where no committed value was made from the same things.

        Args:
            name: `slam`, `learn/NAME` or `parse`.
            load: reads a value back.
            compute: makes the value.
            settings: configuration dataclasses and plain values, by section of the settings file.
            inputs: hashes of what it is made from, by name; `fingerprint` gives those of other stages.
            notes: what else the record is to say, asked for when the value has been computed.

        Raises:
            PipelineError: the value cannot be written.
        """
        plain = plain_values(settings)
        fingerprint = _canonical_hash({"stage": name, "format": FORMAT, "settings": plain, "inputs": inputs})
        record = self.record(name)
        if self._force or record is None or record.fingerprint != fingerprint:
            path, record_path = self.value_path(name), self._record_path(name)
            record_path.unlink(missing_ok=True)
            log.info("%s: computing", name)
            with timed() as timing, stdout_to_stderr():
                value = compute()
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                value.save(path)
            except OSError as error:
                raise PipelineError(f"cannot write {path}: {error.strerror or error}") from error
            record = StageRecord(
                fingerprint=fingerprint,
                value_hash=file_hash(path),
                settings=plain,
                notes=dict(notes()),
                seconds=round(timing.seconds, 6),
                compile_s=round(timing.compile_s, 6),
            )
            record_path.parent.mkdir(parents=True, exist_ok=True)
            write_json(record_path, vars(record))
        else:
            log.info("%s: unchanged", name)
        return load(self.value_path(name))

    def fingerprint(self, name: str) -> str:
        """Hash of everything that a committed stage was made from.

        Raises:
            KeyError: the stage is not committed.
        """
        record = self.record(name)
        if record is None:
            raise KeyError(name)
        return record.fingerprint

    def record(self, name: str) -> StageRecord | None:
        """The record of a committed stage whose value is still the one that was committed."""
        with suppress(OSError, ValueError, TypeError):
            record = StageRecord(**json.loads(self._record_path(name).read_text()))
            if file_hash(self.value_path(name)) == record.value_hash:
                return record
        return None

    def stages(self) -> list[str]:
        """Names of the committed stages, in the order of the work."""
        shapes = sorted((self.path / "stages" / "learn").glob("*.json"))
        names = ["slam", "room", *(f"learn/{path.stem}" for path in shapes), "objects", "parse"]
        return [name for name in names if self.record(name)]

    def value_path(self, name: str) -> Path:
        """Where a stage's value is kept."""
        kind, _, shape = name.partition("/")
        return self.path / "shapes" / f"{shape}.npz" if kind == "learn" else self.path / f"{kind}.npz"

    def _record_path(self, name: str) -> Path:
        return self.path / "stages" / f"{name}.json"


@contextmanager
def open_run_folder(path: Path, inputs: Mapping[str, str], *, force: bool = False) -> Iterator[RunFolder]:
    """Make or reopen a run folder for this process alone; its log.txt takes what the program logs.

    Args:
        path: the folder.
        inputs: hash of what the run is made from, by name.
        force: begin anew where the folder was made from other inputs, and compute stages again.

    Raises:
        PipelineError: the folder cannot be used; the message says why and what to do.
    """
    marker = path / "stages" / "inputs.json"
    with ExitStack() as held:
        try:
            path.mkdir(parents=True, exist_ok=True)
            if any(path.iterdir()) and not marker.parent.is_dir():
                raise PipelineError(f"{path} is not empty and not a run folder; name another with -o")
            held.enter_context(_held_alone(path))
            held.push(partial(_remove_if_fruitless, path))
            marker.parent.mkdir(exist_ok=True)
            _remove_partial_files(path)
            made_from = _read_inputs(marker)
            if made_from and sorted(made_from.values()) != sorted(inputs.values()):
                if not force:
                    raise PipelineError(
                        f"{path} was made from {', '.join(made_from)}; "
                        "name another folder with -o, or begin this one anew with --force"
                    )
                _clear(path)
            write_json(marker, dict(inputs))
            held.enter_context(_logging_to(path / "log.txt"))
        except OSError as error:
            raise PipelineError(f"cannot use {path}: {error.strerror or error}") from error
        yield RunFolder(path, force=force)


def file_hash(path: Path) -> str:
    """SHA-256 of a file, or of the names and contents of all files below a folder."""
    digest = hashlib.sha256()
    if path.is_dir():
        for member in sorted(member for member in path.rglob("*") if member.is_file()):
            digest.update(f"{member.relative_to(path).as_posix()}\0{file_hash(member)}\0".encode())
    else:
        with path.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _read_inputs(marker: Path) -> dict[str, str] | None:
    """What a run folder was made from; None where it is new or was cut off before it was known."""
    try:
        return dict(json.loads(marker.read_text()))
    except (OSError, ValueError, TypeError):
        return None


def _clear(path: Path) -> None:
    """Remove what a run folder holds: records first, so that a cut leaves none without its value."""
    for record in (path / "stages").rglob("*.json"):
        if record.name != "inputs.json":
            record.unlink()
    for member in path.iterdir():
        if member.name in _OWN_FOLDERS:
            shutil.rmtree(member)
        elif member.name in _OWN_FILES:
            member.unlink()


def _remove_if_fruitless(path: Path, kind: type[BaseException] | None, *_: object) -> None:
    """Leave nothing of a run that failed before anything was committed; an interrupted one may go on."""
    if kind is None or not issubclass(kind, Exception):
        return
    _remove_partial_files(path)
    if {file.name for file in path.rglob("*") if file.is_file()} <= {"inputs.json", "log.txt"}:
        shutil.rmtree(path, ignore_errors=True)


def _remove_partial_files(path: Path) -> None:
    """Remove what a killed process did not finish to write."""
    for unfinished in path.rglob(".*.partial*"):
        unfinished.unlink()


def _canonical_hash(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


_OWN_FOLDERS = frozenset({"shapes", "recordings"})
_OWN_FILES = frozenset(
    {
        *("slam.npz", "room.npz", "objects.npz", "parse.npz", "config.toml", "summary.json", "timing.json"),
        *("trajectory.tum", "trajectory.kitti", "poses.csv", "run.mcap", "run.rrd"),
    }
)


@contextmanager
def _held_alone(path: Path) -> Iterator[None]:
    """Keep other processes out; the system lets go when the process ends, however it ends."""
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise PipelineError(f"{path} is in use by another voxscene; wait for it or name another") from error
    try:
        yield
    finally:
        os.close(descriptor)


@contextmanager
def _logging_to(path: Path) -> Iterator[None]:
    """Append the program's log to a file, without clock times."""
    handler = _LogFile(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
        with suppress(OSError):
            handler.close()


class _LogFile(logging.FileHandler):
    """A log that a full disk does not turn into a failure: what matters is told elsewhere."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Go on without the line."""
