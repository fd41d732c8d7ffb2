"""Named arrays in one npz file: written atomically and byte for byte the same, read without trust."""

from __future__ import annotations

import os
import secrets
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

LARGEST_BYTES = 4 << 30
"""An archive whose arrays claim more than this is refused before memory is taken."""

_DAMAGE = (
    ValueError,
    EOFError,
    OSError,
    KeyError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What zipfile and NumPy raise on a damaged file: a header is parsed before the zip's checksum is due."""


def save_arrays(path: str | Path, arrays: Mapping[str, ArrayLike], *, compressed: bool = True) -> None:
    """Write arrays under their names; the file appears whole or not at all, its folder where there is none.

    Zip entries carry no clock, so equal arrays give equal bytes.

    Raises:
        OSError: the folder cannot be written.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        with partial.open("xb") as file:
            save = np.savez_compressed if compressed else np.savez
            save(file, allow_pickle=False, **{name: np.asarray(a) for name, a in arrays.items()})
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def load_arrays(path: str | Path, *, largest_bytes: int = LARGEST_BYTES) -> dict[str, NDArray]:
    """All arrays of an npz file; pickled objects are never read.

    Every array's claimed size is compared with the bytes stored for it before memory is taken.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not an npz file, damaged, or larger than `largest_bytes`; the message names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            claimed = sum(member.file_size for member in members)
            if claimed > largest_bytes:
                raise ValueError(f"its arrays claim {claimed / 2**30:.1f} GiB")
            return {member.filename.removesuffix(".npy"): _read(archive, member) for member in members}
    except _DAMAGE as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{path} is not a readable npz file: {reason}") from error


@dataclass(frozen=True, eq=False)
class Archived:
    """A value whose fields are all arrays, kept in a file under their names."""

    FORMAT_VERSION: ClassVar[int]
    """Of the file."""
    TITLE: ClassVar[str]
    """What messages call the value."""
    OLDER_FORMATS: ClassVar[Mapping[int, Mapping[str, str]]] = MappingProxyType({})
    """Those that are read, and what is called otherwise today."""
    ADDED: ClassVar[Mapping[str, ArrayLike]] = MappingProxyType({})
    """Fields that files of older formats may lack, and what they were then."""

    def save(self, path: str | Path) -> None:
        """Write an npz file, whole or not at all; equal values give equal bytes.

        Raises:
            OSError: the folder cannot be written.
        """
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        save_arrays(path, {"format_version": self.FORMAT_VERSION, **arrays})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is damaged, of another format, or lacks a field.
        """
        arrays = load_arrays(path)
        stored = np.asarray(arrays.pop("format_version", 0))
        version = stored.item() if stored.ndim == 0 else -1
        renamed = {cls.FORMAT_VERSION: {}, **cls.OLDER_FORMATS}.get(version)
        if renamed is None:
            raise ValueError(f"{path} is not a {cls.TITLE} of format {cls.FORMAT_VERSION}")
        arrays = {renamed.get(name, name): array for name, array in arrays.items()}
        if version != cls.FORMAT_VERSION:
            arrays = {name: np.asarray(value) for name, value in cls.ADDED.items()} | arrays
        if differing := {field.name for field in fields(cls)} ^ set(arrays):
            raise ValueError(f"{path} is not a {cls.TITLE}: {', '.join(sorted(differing))}")
        return cls(**arrays)


def _read(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray:
    with archive.open(member) as stream:
        version = np.lib.format.read_magic(stream)
        read_header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read_header(stream)
        stored = member.file_size - stream.tell()
        if (
            dtype.hasobject
            or dtype.kind not in "biufSU"
            or not dtype.itemsize
            or int(np.prod(shape, dtype=object)) * dtype.itemsize != stored
        ):
            raise ValueError(f"array {member.filename} does not hold what it claims")
    with archive.open(member) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)
