"""Where the bytes of a recording come from: a file, or a zstd-compressed file unpacked as it is read."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Protocol

import zstandard

from recordings.errors import RecordingError

ZSTD_SUFFIXES = (".zstd", ".zst")
"""Of files that rosbag2 compressed, and those of the zstd program."""
_STEP = 1 << 20
_KEPT = 4 * _STEP
_SMALLEST_LIMIT, _LARGEST_RATIO = 1 << 26, 1000
"""How much may come out of a compressed file: images of one value compress 1000-fold, zeros 30,000-fold."""


class Source(Protocol):
    """Bytes at offsets; `size` is None where it is not known before the end is met."""

    @property
    def size(self) -> int | None:
        """Number of bytes."""
        ...

    def read(self, offset: int, length: int) -> bytes:
        """At most `length` bytes from `offset`, fewer only at the end."""
        ...


class FileSource:
    """A plain file."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.size = os.fstat(file.fileno()).st_size

    def read(self, offset: int, length: int) -> bytes:
        """At most `length` bytes from `offset`; a length that the file cannot hold takes no memory."""
        if not 0 <= offset < self.size:
            return b""
        self._file.seek(offset)
        return self._file.read(max(0, min(length, self.size - offset)))


class ZstdSource:
    """A `.mcap.zstd` or `.mcap.zst` file, unpacked as it is read.

    Reading forward unpacks once. The last few megabytes are kept, so that a step back is free; a
    longer way back unpacks again from the front. One that unpacks to more than depth ever does is cut there.
    """

    size = None

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._limit = max(_SMALLEST_LIMIT, _LARGEST_RATIO * os.fstat(file.fileno()).st_size)
        self._restart()

    def read(self, offset: int, length: int) -> bytes:
        """At most `length` bytes from `offset`; a damaged stream ends where its damage begins."""
        if offset < self._position - len(self._kept):
            self._restart()
        while self._position < offset:
            if not self._unpack(min(offset - self._position, _STEP)):
                return b""
        pieces = [bytes(self._kept[len(self._kept) - (self._position - offset) :][:length])]
        missing = length - len(pieces[0])
        while missing > 0 and (piece := self._unpack(min(missing, _STEP))):
            pieces.append(piece)
            missing -= len(piece)
        return b"".join(pieces)

    def _restart(self) -> None:
        self._file.seek(0)
        unpacker = zstandard.ZstdDecompressor()
        self._stream = unpacker.stream_reader(self._file, read_across_frames=True, closefd=False)
        self._position = 0
        self._kept = bytearray()

    def _unpack(self, length: int) -> bytes:
        try:
            piece = self._stream.read(min(length, max(0, self._limit - self._position)))
        except zstandard.ZstdError:
            piece = b""
        self._position += len(piece)
        self._kept += piece
        del self._kept[:-_KEPT]
        return piece


@contextmanager
def open_source(path: Path) -> Iterator[Source]:
    """The bytes of the MCAP file at `path`.

    Raises:
        RecordingError: the file cannot be opened or read.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise RecordingError(f"cannot read {path}: it is a pipe or a device; copy it to a file")
    try:
        with path.open("rb") as file:
            yield ZstdSource(file) if path.suffix in ZSTD_SUFFIXES else FileSource(file)
    except OSError as error:
        raise RecordingError(f"cannot read {path}: {error.strerror}") from error
