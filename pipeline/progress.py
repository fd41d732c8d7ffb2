"""What is going on, on stderr: phase, rate and remaining time, for anything over two seconds."""

from __future__ import annotations

import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from statistics import median
from types import TracebackType
from typing import TextIO

import click

Report = Callable[[int, int | None], None]
"""Is told how many of how many steps are done; None where nobody knows how many there are."""

SILENT_S = 2.0
"""Work that ends sooner shows nothing."""
TERMINAL_INTERVAL_S = 0.2
LINE_INTERVAL_S = 10.0
"""Where stderr is a file or a pipe, a line this often."""
WINDOW_S = 8.0
"""The rate is that of so many last seconds: work grows harder or easier."""
PAUSE = 10.0
"""A step of so many times the median one is a pause, mostly to compile: it says nothing of the rest."""
FEW_STEPS = 3
"""Fewer tell no remaining time, unless they fill those seconds: the first ones compile."""

_shown: list[Progress] = []
"""Displays that are open, the innermost last: it alone shows anything."""


def tell(text: str, *, err: bool = False) -> None:
    """Print lines on stdout, or on stderr, where a display may stand on the terminal's line: it is wiped."""
    for display in _shown[-1:]:
        display.give_way()
    click.echo(text, err=err)


class Progress:
    """A callable that stages call with what is done and what there is; the stage itself has no clock.

    Between calls a thread shows that the program lives, and in which phase; not under a clock of one's own.

    Args:
        label: what is going on.
        unit: what is counted, such as "frames".
        quiet: show nothing.
        stream: where to; stderr by default.
        clock: seconds, monotonic; the system's unless given.
    """

    def __init__(
        self,
        label: str,
        unit: str,
        *,
        quiet: bool = False,
        stream: TextIO | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._label = label
        self._unit = unit
        self._quiet = quiet
        self._stream = stream or sys.stderr
        self._ticks = clock is None and not quiet
        self._clock = clock or time.monotonic
        self._terminal = self._stream.isatty()
        self._interval_s = TERMINAL_INTERVAL_S if self._terminal else LINE_INTERVAL_S
        self._begun_s = self._clock()
        self._shown_s = self._begun_s + SILENT_S - self._interval_s
        self._samples: deque[tuple[float, int]] = deque()
        self._total: int | None = None
        self._phase = "starting"
        self._width = 0
        self._lock = threading.Lock()
        self._ended = threading.Event()

    def __enter__(self) -> Progress:
        if _shown:
            _shown[-1].give_way()
        _shown.append(self)
        if self._ticks:
            threading.Thread(target=self._tick, daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        with self._lock:
            _shown.remove(self)
            self._wipe()

    def give_way(self) -> None:
        """Leave the terminal's line to a display that opens now, or to lines that are printed now."""
        with self._lock:
            self._wipe()

    def phase(self, name: str) -> None:
        """Tell what is being done before the first unit, after the last, or between two."""
        with self._lock:
            self._phase = name
            self._samples.clear()
            self._show_if_due()

    def __call__(self, done: int, total: int | None = None) -> None:
        """Tell that `done` units of `total` (None: nobody knows) are finished."""
        with self._lock:
            now = self._clock()
            self._samples.append((now, done))
            while len(self._samples) > 2 and self._samples[1][0] <= now - WINDOW_S:
                self._samples.popleft()
            self._total = total
            self._show_if_due()

    def _tick(self) -> None:
        while not self._ended.wait(TERMINAL_INTERVAL_S):
            with self._lock:
                if _shown and _shown[-1] is self:
                    self._show_if_due()

    def _show_if_due(self) -> None:
        now = self._clock()
        if self._quiet or now - self._shown_s < self._interval_s:
            return
        self._shown_s = now
        text = (
            self._counted()
            if self._samples
            else f"{self._label}: {self._phase}, {_minutes(now - self._begun_s)}"
        )
        if self._terminal:
            text = _last(text, shutil.get_terminal_size().columns - 1)
            self._stream.write("\r" + text.ljust(self._width))
            self._width = len(text)
        else:
            self._stream.write(text + "\n")
        self._stream.flush()

    def _wipe(self) -> None:
        if self._width:
            self._stream.write("\r" + " " * self._width + "\r")
            self._stream.flush()
            self._width = 0
            self._shown_s = self._clock()  # what is printed now comes before the line is drawn again

    def _counted(self) -> str:
        """What is done, at what rate, and the time that is left at that rate."""
        done, total, rate = self._samples[-1][1], self._total, self._rate()
        count = f"{self._label}: {done}{'' if total is None else f'/{total}'} {self._unit}"
        if rate is None:
            return count
        if total is None:
            return f"{count}, {rate:.3g}/s"
        return f"{count}, {rate:.3g}/s, {_minutes(max(total - done, 0) / rate)} left"

    def _rate(self) -> float | None:
        """Units a second of the last steps, without pauses; None where they are too few."""
        samples = list(self._samples)
        steps = [
            (now_s - then_s, done - before)
            for (then_s, before), (now_s, done) in pairwise(samples)
            if done > before
        ]
        if len(steps) < FEW_STEPS and sum(seconds for seconds, _ in steps) < WINDOW_S:
            return None
        usual_s = median(seconds / units for seconds, units in steps)
        work = [step for step in steps if step[0] <= PAUSE * usual_s * step[1]]
        seconds = sum(seconds for seconds, _ in work)
        return sum(units for _, units in work) / seconds if seconds > 0 else None


def _last(text: str, width: int) -> str:
    """The text, or its end where it has more than `width` characters: a line that wraps is not wiped."""
    return text if len(text) <= width else f"...{text[3 - width :]}"


def _minutes(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
