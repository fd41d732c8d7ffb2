"""What ends the program from outside."""

import importlib
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.interruption import end_on_signals

SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGALRM
GUARDED = """
import os, signal
try:
    for number in {numbers}:
        os.kill(os.getpid(), number)
    missing = False
except BaseException:
    missing = True
"""
"""A module that takes whatever happens for something that is not installed, as trimesh does."""


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """The program's handlers of signals; afterwards the ones before."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    end_on_signals()
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    for number, handler in before.items():
        signal.signal(number, handler)


def imported(name: str, numbers: list[int], folder: Path, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Whether a module that gets these signals while it is imported takes them for something missing."""
    (folder / f"{name}.py").write_text(GUARDED.format(numbers=numbers))
    monkeypatch.syspath_prepend(folder)
    return importlib.import_module(name).missing


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_import_swallows_no_signal(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is done first, whole; the program ends right after it."""
    assert not imported(f"guarded_{number:d}", [int(number)], tmp_path, monkeypatch)

    with pytest.raises(KeyboardInterrupt):
        time.sleep(5)


def test_a_second_signal_ends_an_import(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that hangs can be ended."""
    assert imported("guarded_twice", [int(signal.SIGTERM)] * 2, tmp_path, monkeypatch)


def test_without_an_import_a_signal_ends_at_once() -> None:
    """Nothing is waited for."""
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)


def test_what_was_started_to_ignore_ctrl_c_does() -> None:
    """As a job in the background of a shell script."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_on_signals()

    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
