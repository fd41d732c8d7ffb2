"""Values that leave memory come back as they were."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from slam.keyframes.pages import PageFile


@dataclass(frozen=True)
class Pair:
    """Two arrays and what all share."""

    ARRAYS: ClassVar[int] = 2
    ROOM: ClassVar[int] = 3

    one: Any
    other: Any
    shared: str

    def stored(self) -> Sequence[np.ndarray]:
        """Both."""
        return self.one, self.other

    def with_stored(self, arrays: Sequence[Any]) -> "Pair":
        """Others."""
        return Pair(arrays[0], arrays[1], self.shared)


def _pair(number: int) -> Pair:
    return Pair(np.full((2, 3), number, np.float32), np.arange(number), "of all")


def test_values_come_back_as_they_were():
    """Ten of which three have room, asked for in any order, some of them twice."""
    pages = PageFile()
    held = [pages.hold(_pair(number)) for number in range(10)]

    for number in (0, 9, 3, 3, 5, 0):
        value = held[number].value
        np.testing.assert_array_equal(value.one, _pair(number).one)
        np.testing.assert_array_equal(value.other, np.arange(number))
        assert value.one.dtype == np.float32
        assert value.shared == "of all"


def test_what_is_asked_for_again_stays():
    """The one that was not leaves."""
    pages = PageFile()
    first, second, third = (pages.hold(_pair(number)) for number in range(3))
    kept, gone = first.value, second.value

    assert third.value is not None
    assert first.value is kept
    new = pages.hold(_pair(7))

    assert first.value is kept
    assert second.value is not gone
    assert new.value is not None


def test_what_nobody_holds_is_not_written():
    """A map that is refined at every frame would fill the disk."""
    pages = PageFile()
    for number in range(100):
        pages.hold(_pair(number))

    assert pages.size == 0


def test_a_full_disk_keeps_values_in_memory():
    """More than have room, but nothing is lost."""

    class Full(io.BytesIO):
        def write(self, *_: Any) -> int:
            raise OSError(28, "No space left on device")

    pages = PageFile(Full())
    held = [pages.hold(_pair(number)) for number in range(8)]

    assert [int(one.value.one[0, 0]) for one in held] == list(range(8))
    with pytest.raises(OSError, match="space"):
        held[0].written()
