"""Arrays on disk: made once, by what decides them, and the oldest dropped."""

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike

from shapes import array_cache
from shapes.array_cache import Arrays, cached_arrays


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of its own."""
    monkeypatch.setattr(array_cache, "user_cache_path", lambda *_, **__: tmp_path)
    return tmp_path / "numbers"


class Made:
    """Makes arrays and counts how often."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self, *made_from: ArrayLike, source: str = __file__) -> Arrays:
        """From the cache or anew."""

        def make() -> Arrays:
            self.times += 1
            return {"number": np.array([self.times])}

        return cached_arrays("numbers", made_from, [source], make, lambda arrays: "number" in arrays)


def test_arrays_are_made_once(folder: Path) -> None:
    """Also by another process, which has another `Made`."""
    first, second = Made(), Made()

    assert first(np.arange(3), 0.5) == second(np.arange(3), 0.5) == {"number": np.array([1])}
    assert (first.times, second.times, len(list(folder.iterdir()))) == (1, 0, 1)


@pytest.mark.parametrize(
    "other",
    [(np.arange(4), 0.5), (np.arange(3.0), 0.5), (np.arange(3)[None], 0.5), (np.arange(3), 0.25)],
)
def test_what_decides_them_decides_the_file(other: tuple[ArrayLike, ...]) -> None:
    """Another size, type, shape or value."""
    made = Made()
    made(np.arange(3), 0.5)
    made(*other)

    assert made.times == 2


def test_other_sources_make_them_anew(tmp_path: Path) -> None:
    """By their content."""
    source, made = tmp_path / "source.py", Made()
    for text in ("a", "b", "a"):
        source.write_text(text)
        made(1, source=str(source))

    assert made.times == 2


def test_the_oldest_are_dropped(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was read lately is not old."""
    monkeypatch.setattr(array_cache, "MOST_FILES", 2)
    made = Made()
    for age, number in enumerate((1, 2)):
        made(number)
        for file in folder.iterdir():
            os.utime(file, (1000 + age, 1000 + age))
    made(1)
    made(3)
    made(1)
    made(3)

    assert made.times == 3
    assert len(list(folder.iterdir())) == 2


def test_a_folder_that_can_only_be_read_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of use cannot be kept there; the arrays are read all the same."""
    made = Made()
    made(1)

    def refuse(path: Path) -> None:
        raise PermissionError(path)

    monkeypatch.setattr(Path, "touch", refuse)
    made(1)

    assert made.times == 1
