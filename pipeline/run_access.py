"""Opening a run folder: by one process at a time, for what it was made from, with its log."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from pipeline.atomic import write_json
from pipeline.errors import PipelineError
from pipeline.logs import log, logging_to
from pipeline.machine import machine, versions
from pipeline.run_folder import INPUTS, RunFolder, read_inputs
from recordings.errors import RecordingError

_OWN_FOLDERS = frozenset({"shapes", "recordings"})
_OWN_FILES = frozenset(
    {
        *("slam.npz", "room.npz", "objects.npz", "parse.npz", "config.toml", "summary.json", "timing.json"),
        *("trajectory.tum", "trajectory.kitti", "lost.txt", "poses.csv", "sensor.toml"),
        *("run.mcap", "run.rrd", "run.truth.rrd"),
    }
)


@contextmanager
def open_run_folder(
    path: Path, inputs: Mapping[str, str], *, force: bool = False, replace: bool = False
) -> Iterator[RunFolder]:
    """Make or reopen a run folder for this process alone; its log.txt takes what the program logs.

    Args:
        path: the folder.
        inputs: hash of what the run is made from, by name.
        force: compute stages again.
        replace: begin anew where the folder was made from other inputs, as `force` does.

    Raises:
        PipelineError: the folder cannot be used; the message says why and what to do.
    """
    marker = path / INPUTS
    with ExitStack() as held:
        try:
            if path.is_file():
                raise PipelineError(f"cannot use {path}: it is a file; name a folder with -o")
            path.mkdir(parents=True, exist_ok=True)
            if any(path.iterdir()) and not _is_run_folder(marker):
                raise PipelineError(f"{path} is not empty and not a run folder; name another with -o")
            held.enter_context(_held_alone(path))
            held.push(partial(_remove_if_fruitless, path))
            marker.parent.mkdir(exist_ok=True)
            _remove_partial_files(path)
            made_from = read_inputs(path)
            if made_from and sorted(made_from.values()) != sorted(inputs.values()):
                if not (force or replace):
                    raise PipelineError(
                        f"{path} was made from {', '.join(made_from)}; "
                        "name another folder with -o, or begin this one anew with --force"
                    )
                _clear(path)
            write_json(marker, dict(inputs))
            held.enter_context(logging_to(path / "log.txt"))
            _log_beginning()
        except OSError as error:
            raise PipelineError(f"cannot use {path}: {error.strerror or error}") from error
        yield RunFolder(path, force=force)


def _is_run_folder(marker: Path) -> bool:
    """Whether a folder is one: it has the marker, or was killed before it had."""
    return marker.is_file() or (marker.parent.is_dir() and not any(marker.parent.iterdir()))


def _clear(path: Path) -> None:
    """Remove what a run folder holds: records first, so that a cut leaves none without its value."""
    for record in (path / "stages").rglob("*.json"):
        if record.name != INPUTS.name:
            record.unlink()
    RunFolder(path).value_path("sensor").unlink(missing_ok=True)
    for member in path.iterdir():
        if member.name in _OWN_FOLDERS:
            shutil.rmtree(member)
        elif member.name in _OWN_FILES:
            member.unlink()


def _remove_if_fruitless(path: Path, kind: type[BaseException] | None, *_: object) -> None:
    """Leave nothing of a run that failed before anything was committed.

    An interrupted one may go on; one that met a mistake of the program has its traceback in log.txt.
    """
    if kind is None or not issubclass(kind, PipelineError | RecordingError | OSError):
        return
    _remove_partial_files(path)
    if {file.name for file in path.rglob("*") if file.is_file()} <= {INPUTS.name, "log.txt"}:
        shutil.rmtree(path, ignore_errors=True)


def _remove_partial_files(path: Path) -> None:
    """Remove what a killed process did not finish to write."""
    for unfinished in path.rglob(".*.partial*"):
        unfinished.unlink()


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


def _log_beginning() -> None:
    """What is about to be done, by which program, on what."""
    cores, processor = machine()["cores"], machine()["processor"]
    log.info("voxscene %s: %s", versions().get("voxscene", "of unknown version"), shlex.join(sys.argv[1:]))
    log.info("on %s, %s cores, %s", processor, cores, ", ".join(f"{k} {v}" for k, v in versions().items()))
