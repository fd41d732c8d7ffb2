"""What the program says of its work: to log.txt in the run folder, and warnings to stderr."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.errors import PipelineError
from pipeline.progress import tell
from recordings.errors import RecordingError

log = logging.getLogger("voxscene")
log.setLevel(logging.INFO)
log.propagate = False

FORESEEN = (PipelineError, RecordingError, OSError, KeyboardInterrupt, GeneratorExit)
"""Errors that say in one line what is wrong; others need their traceback."""


_IN_LOG = "the traceback is in "
"""How a note begins that names the log; libraries add notes of their own."""


def show_on_stderr(level: int) -> None:
    """Print what is logged at this level or above on stderr, as every message of the program."""
    log.handlers = [one for one in log.handlers if not isinstance(one, _Stderr)]
    log.addHandler(_Stderr(level))


@contextmanager
def logging_to(path: Path) -> Iterator[None]:
    """Append the log to a file, without clock times; an error that leaves the block stands in it too.

    One that nobody foresaw has its traceback there, and a note that says where.
    """
    handler = _LogFile(path, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    log.addHandler(handler)
    try:
        yield
    except BaseException as error:
        _append_error(handler, error)
        if not isinstance(error, FORESEEN):
            error.add_note(f"{_IN_LOG}{path}")
        raise
    finally:
        log.removeHandler(handler)
        with suppress(OSError):
            handler.close()


def unforeseen(error: Exception) -> str:
    """One line for an error that nobody foresaw, and where its traceback is; writes it where none has yet."""
    said = str(error).strip().splitlines()
    what = f"{type(error).__name__}: {said[0]}" if said else type(error).__name__
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in what:
        return f"there is not enough memory ({what}); ask for less: fewer particles, frames or pixels"
    notes = [note for note in getattr(error, "__notes__", []) if note.startswith(_IN_LOG)]
    place = notes[-1].removeprefix(_IN_LOG) if notes else _write_traceback(error)
    return f"{what}; this is a mistake of the program, please report it with the traceback in {place}"


def _write_traceback(error: Exception) -> str:
    """Where the traceback of an error outside of any run folder was written."""
    from platformdirs import user_log_path

    try:
        path = user_log_path("voxscene", appauthor=False, ensure_exists=True) / "log.txt"
        path.write_text("".join(traceback.format_exception(error)), errors="backslashreplace")
    except OSError:
        return f"nowhere, for {user_log_path('voxscene', appauthor=False)} cannot be written"
    return str(path)


def _append_error(handler: logging.Handler, error: BaseException) -> None:
    exc_info = None if isinstance(error, FORESEEN) else (type(error), error, error.__traceback__)
    said = " ".join(str(error).split()) or type(error).__name__
    handler.handle(log.makeRecord(log.name, logging.ERROR, "", 0, said, (), exc_info))


class _LogFile(logging.FileHandler):
    """A log that a full disk does not turn into a failure: what matters is told elsewhere."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Go on without the line."""


class _Stderr(logging.Handler):
    """Lines on the stderr of the moment."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one."""
        tell(f"voxscene: {record.getMessage()}", err=True)
