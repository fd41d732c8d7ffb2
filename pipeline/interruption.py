"""Ctrl-C and SIGTERM end the program by one KeyboardInterrupt, which no import swallows."""

from __future__ import annotations

import signal
from types import FrameType

_AGAIN_S = 0.05
"""Until it is looked again whether the import that was under way is done."""
_IMPORTING = "<frozen importlib._bootstrap>"
"""The file of the frames that an import runs in."""


def end_on_signals() -> None:
    """Let SIGTERM, and Ctrl-C unless this process was started to ignore it, raise KeyboardInterrupt.

    An import is let finish first: raised inside one, it ends as an ImportError of an extension module, or
    nowhere where a library guards its imports by a bare `except`. A second signal ends an import too.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """What ends the program from outside ends it as Ctrl-C does: nothing half-written stays."""
    if _waits_for_import(number, frame):
        signal.signal(signal.SIGALRM, _interrupt)
        signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        return
    raise KeyboardInterrupt


def _waits_for_import(number: int, frame: FrameType | None) -> bool:
    """Whether an import is under way, and nobody asks a second time to end it."""
    if not hasattr(signal, "setitimer"):  # not on Windows
        return False
    if number != signal.SIGALRM and signal.getitimer(signal.ITIMER_REAL)[0] > 0:
        signal.setitimer(signal.ITIMER_REAL, 0)
        return False
    while frame is not None:
        if frame.f_code.co_filename == _IMPORTING:
            return True
        frame = frame.f_back
    return False
