"""Keeping now and then how far a stage came, so that one that is killed goes on from there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Protocol, TypeVar

from pipeline.logs import log
from pipeline.timing import wall_clock

INTERVAL_S = 20.0
"""Work of this time may be lost, and of more where writing takes long."""
LONGEST_SHARE = 0.05
"""Of the time may go into writing: what takes more than a second to write is written less often."""

PAGES = ".pages"
"""Ending of the file for what has no room in memory."""

C = TypeVar("C", bound="Saved")


class Saved(Protocol):
    """How far a stage came."""

    def save(self, path: Path) -> None:
        """Write it to one file, whole or not at all."""
        ...


class CheckpointKeeper:
    """Writes checkpoints to a file, not too often; what cannot be written is left.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._last_s = wall_clock()
        self._wait_s = INTERVAL_S

    @contextmanager
    def pages(self) -> Iterator[BinaryIO | None]:
        """A file beside it for what a stage has no room for in memory; None where it cannot be written.

        Afterwards it stays only where a checkpoint, which is what refers to it, does.
        """
        path = self._path.with_name(f"{self._path.name}{PAGES}")
        with ExitStack() as stack:
            file = None
            with suppress(OSError):
                file = stack.enter_context(
                    path.open("r+b" if path.exists() and self._path.exists() else "w+b")
                )
            try:
                yield file
            finally:
                if not self._path.exists():
                    path.unlink(missing_ok=True)

    def found(self, load: Callable[[Path], C]) -> C | None:
        """The checkpoint that was kept before, if there is one and it is whole."""
        with suppress(OSError):
            try:
                checkpoint = load(self._path)
            except ValueError as error:
                log.info("%s: beginning anew", error)
                return None
            log.info("going on from a checkpoint")
            return checkpoint
        return None

    def keep(self, checkpoint: Saved) -> None:
        """Write a checkpoint, if the last one is old enough."""
        begun_s = wall_clock()
        if begun_s - self._last_s < self._wait_s:
            return
        try:
            checkpoint.save(self._path)
        except OSError as error:
            log.info("no checkpoint: %s", error.strerror or error)
        self._last_s = wall_clock()
        self._wait_s = max(INTERVAL_S, (self._last_s - begun_s) / LONGEST_SHARE)
