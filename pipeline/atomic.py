"""Files that appear whole or not at all, and survive a kill or a power cut once they have appeared."""

from __future__ import annotations

import csv
import io
import json
import os
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.errors import PipelineError

RECORDINGS = (b"\x89MCAP0\r\n", b"#ROSBAG", b"SQLite format 3\x00")
"""First bytes of MCAP files, bags of ROS 1 and those of rosbag2."""


def check_output(path: Path) -> None:
    """Refuse a file that cannot be written, or that would take a recording's place, before any work.

    Raises:
        PipelineError: it says what stands in the way.
    """
    if not path.parent.is_dir():
        raise PipelineError(f"cannot write {path}: there is no folder {path.parent}")
    if path.is_dir():
        raise PipelineError(f"cannot write {path}: it is a folder, name a file in it")
    if path.is_file():
        with path.open("rb") as file:
            if file.read(16).startswith(RECORDINGS):
                raise PipelineError(f"cannot write {path}: it is a recording, name another file")


def check_replaced(path: Path, kind: str, is_one: Callable[[Path], bool]) -> None:
    """Refuse to take the place of a file of another kind, before any work; an empty one is of any kind.

    Args:
        path: of the output, there or not.
        kind: of file that is to be written, in words.
        is_one: whether the file there is of that kind.

    Raises:
        PipelineError: it is not.
    """
    if path.is_file() and path.stat().st_size and not is_one(path):
        raise PipelineError(f"cannot write {path}: it is there and is no {kind}, name another file")


@contextmanager
def atomic_path(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """A temporary path of the same suffix; it takes the place of `path` when the block ends well.

    Its name is its own: of several writers to one path, the last whole file stays. A recording is never
    replaced (`recordings.writer` replaces its own).

    Args:
        path: the file.
        durable: whether it survives a power cut; waiting for the disk takes milliseconds.

    Raises:
        PipelineError: the file cannot be written, or is a recording.
    """
    if path.exists():
        check_output(path)
    partial = path.with_name(f".{path.stem}.{secrets.token_hex(4)}.partial{path.suffix}")
    try:
        yield partial
        if durable:
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
        partial.replace(path)
        if durable:
            _sync(path.parent)
    except OSError as error:
        raise PipelineError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # on a disk that is read-only it was never made
            partial.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically, unless it holds these bytes already."""
    if path.is_file() and path.read_bytes() == content:
        return
    with atomic_path(path) as partial:
        partial.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, unless it holds the text already; names of files in it may be any."""
    write_bytes(path, as_text(text).encode())


def as_text(text: str) -> str:
    """The same with a question mark for each byte of a file's name that is no UTF-8, as text has to be."""
    return text.encode(errors="replace").decode()


def write_json(path: Path, content: object) -> None:
    """Write a JSON document atomically, for people too; numbers that are not finite are refused."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, object]]) -> None:
    """Write a CSV file atomically: a heading, then of every row what the columns name; None is empty.

    Raises:
        PipelineError: the file cannot be written.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def _sync(folder: Path) -> None:
    """Make a new name in a folder survive a power cut, where the system can."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
