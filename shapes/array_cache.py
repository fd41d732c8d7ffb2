"""Arrays that took long to make, kept in the user's cache folder.

A damaged file is made anew. Where the folder cannot be written the arrays are made each time. Of each kind
the `MOST_FILES` that were used last stay.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from platformdirs import user_cache_path

from shapes.archive import load_arrays, save_arrays

MOST_FILES = 512
"""Of one kind: of the largest, voxels of an object, some 0.8 GB."""

Arrays = dict[str, NDArray]

_log = logging.getLogger("voxscene.cache")


def cached_arrays(
    kind: str,
    made_from: Sequence[ArrayLike],
    sources: Sequence[str],
    make: Callable[[], Arrays],
    is_whole: Callable[[Arrays], bool],
) -> Arrays:
    """The arrays of the cache, or made and kept there.

    Args:
        kind: name of their folder.
        made_from: what decides them.
        sources: files of the code that makes them.
        make: makes them.
        is_whole: whether arrays that were read are what `make` makes, by names, types and sizes.
    """
    path = user_cache_path("voxscene", appauthor=False) / kind / f"{_digest(made_from, sources)}.npz"
    kept = _read(path, is_whole)
    if kept is not None:
        return kept
    made = make()
    try:
        save_arrays(path, made)
        _drop_oldest(path.parent)
    except OSError as error:
        _log.info("%s cannot be written, its arrays are made each time: %s", path, error)
    return made


def _digest(made_from: Sequence[ArrayLike], sources: Sequence[str]) -> str:
    digest = hashlib.sha256()
    for source in sources:
        digest.update(hashlib.sha256(Path(source).read_bytes()).digest())
    for one in map(np.asarray, made_from):
        digest.update(f"{one.dtype.str}{one.shape}".encode())
        digest.update(np.ascontiguousarray(one).tobytes())
    return digest.hexdigest()[:32]


def _read(path: Path, is_whole: Callable[[Arrays], bool]) -> Arrays | None:
    """What a file holds; None where there is none, or a damaged one."""
    try:
        arrays = load_arrays(path)
        if is_whole(arrays):
            with suppress(OSError):  # a folder that can only be read
                path.touch()
            return arrays
        _log.info("%s does not hold what it should: made anew", path)
    except FileNotFoundError:
        pass
    except (ValueError, OSError) as error:
        _log.info("%s is made anew: %s", path, error)
    return None


def _drop_oldest(folder: Path) -> None:
    files = sorted(folder.glob("*.npz"), key=_used_at)
    for file in files[:-MOST_FILES]:
        with suppress(OSError):
            file.unlink(missing_ok=True)


def _used_at(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:  # another process has dropped it
        return 0.0
