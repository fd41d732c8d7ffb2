"""Compiled kernels on disk, each under a checksum: JAX's own cache would run what a bad disk made of one.

JAX writes entries in place and never replaces one: what a killed process leaves half-written stays so.
"""

from __future__ import annotations

import hashlib
import shutil
from contextlib import suppress
from pathlib import Path

from pipeline.atomic import atomic_path
from pipeline.errors import PipelineError
from pipeline.logs import log

DIGEST_BYTES = hashlib.sha256().digest_size
SUFFIX = "-checked"
"""Beside `-cache` of JAX's own entries, which other programs may keep in the same folder."""


MOST_VERSIONS = 4
"""Of the program whose traces are kept, some 10 MB each: developers make one with every change."""


def trace_cache(folder: Path, version: str) -> KernelCache:
    """The traces of one version of the program, below a folder; those of the oldest others are dropped."""
    mine = folder / "traces" / version[:32]
    if not mine.is_dir():
        mine.mkdir(parents=True)
        others = sorted(mine.parent.iterdir(), key=lambda one: one.stat().st_mtime)
        for old in others[:-MOST_VERSIONS]:
            shutil.rmtree(old, ignore_errors=True)
    return KernelCache(mine)


class KernelCache:
    """Entries by key, as JAX's `CacheInterface` asks for them; what is damaged is dropped and told once."""

    def __init__(self, folder: Path) -> None:
        """A cache in a folder, which is made."""
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder
        self._told = False

    def get(self, key: str) -> bytes | None:
        """The entry, None where there is none that is whole."""
        path = self._entry(key)
        try:
            stored = path.read_bytes()
        except OSError:
            return None
        digest, content = stored[:DIGEST_BYTES], stored[DIGEST_BYTES:]
        if hashlib.sha256(content).digest() == digest:
            return content
        with suppress(OSError):
            path.unlink(missing_ok=True)
        if not self._told:
            log.warning("%s: a compiled kernel is damaged; such ones are compiled anew", path)
            self._told = True
        return None

    def put(self, key: str, value: bytes) -> None:
        """Keep an entry; on a full disk it is not kept."""
        with suppress(PipelineError), atomic_path(self._entry(key), durable=False) as partial:
            partial.write_bytes(hashlib.sha256(value).digest() + value)

    def _entry(self, key: str) -> Path:
        return self._path / f"{key}{SUFFIX}"
