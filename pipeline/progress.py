"""How far a long piece of work is, on stderr: rate and remaining time, for anything over two seconds."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import TextIO

SILENT_S = 2.0
"""Work that ends sooner shows nothing."""
TERMINAL_INTERVAL_S = 0.2
LINE_INTERVAL_S = 10.0
"""Where stderr is a file or a pipe, a line this often."""


class Progress:
    """A callable that stages call with what is done and what there is; the stage itself has no clock.

    The rate is that since the first call, before which kernels are compiled and inputs read.

    Args:
        label: what is going on.
        unit: what is counted, such as "frames".
        quiet: show nothing.
        stream: where to; stderr by default.
        clock: seconds, monotonic.
    """

    def __init__(
        self,
        label: str,
        unit: str,
        *,
        quiet: bool = False,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._label = label
        self._unit = unit
        self._quiet = quiet
        self._stream = stream or sys.stderr
        self._clock = clock
        self._terminal = self._stream.isatty()
        self._interval_s = TERMINAL_INTERVAL_S if self._terminal else LINE_INTERVAL_S
        self._shown_s = clock() + SILENT_S - self._interval_s
        self._first: tuple[float, int] | None = None
        self._width = 0

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._width:
            self._stream.write("\r" + " " * self._width + "\r")
            self._stream.flush()

    def __call__(self, done: int, total: int | None = None) -> None:
        """Tell that `done` units of `total` (None: nobody knows) are finished."""
        now = self._clock()
        begun_s, first = self._first = self._first or (now, done)
        if self._quiet or now - self._shown_s < self._interval_s:
            return
        self._shown_s = now
        text = self._text(done, total, (done - first) / (now - begun_s) if done > first else None)
        if self._terminal:
            self._stream.write("\r" + text.ljust(self._width))
            self._width = len(text)
        else:
            self._stream.write(text + "\n")
        self._stream.flush()

    def _text(self, done: int, total: int | None, rate: float | None) -> str:
        count = f"{self._label}: {done}{'' if total is None else f'/{total}'} {self._unit}"
        if rate is None:
            return count
        if total is None:
            return f"{count}, {rate:.3g}/s"
        return f"{count}, {rate:.3g}/s, {_minutes(max(total - done, 0) / rate)} left"


def _minutes(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
