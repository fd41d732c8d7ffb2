"""Values that leave memory: the least recently used are written to a file, and read again when asked for.

An hour's keyframes are gigabytes, of which a frame needs a few. A `Paged` value never changes, wherever it
is: a map that is refined holds another one, and what nobody holds any more is never written.
"""

from __future__ import annotations

import io
import os
import weakref
from collections import OrderedDict
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, BinaryIO, ClassVar, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Pageable(Protocol):
    """A value most of which are a few arrays of its own.

    Attributes:
        ROOM: values of this kind that are in memory at once.
        ARRAYS: how many they are.
    """

    ROOM: ClassVar[int]
    ARRAYS: ClassVar[int]

    def stored(self) -> Sequence[ArrayLike]:
        """Its own arrays."""
        ...

    def with_stored(self, arrays: Sequence[Any]) -> Self:
        """The same value with these arrays in their places, or with None in all of them."""
        ...


V = TypeVar("V", bound=Pageable)


class PageFile:
    """A file that arrays are appended to, and which values are in memory.

    Args:
        file: opened for reading and writing; what it holds is kept. None is a file in memory.
    """

    def __init__(self, file: BinaryIO | None = None) -> None:
        self.file: BinaryIO = io.BytesIO() if file is None else file
        self._in_memory: dict[type, OrderedDict[int, weakref.ref[Paged[Any]]]] = {}

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self.file.seek(0, io.SEEK_END)

    def flush(self) -> None:
        """Have it all on the disk.

        Raises:
            OSError: there is no room.
        """
        self.file.flush()
        with suppress(io.UnsupportedOperation):
            os.fsync(self.file.fileno())

    def hold(self, value: V) -> Paged[V]:
        """A value that may leave memory when it has not been asked for for long."""
        held = Paged(self, value.with_stored([None] * value.ARRAYS), value, None)
        self.touch(held)
        return held

    def touch(self, held: Paged[V]) -> None:
        """Take a value for the last one used; the least recently used one leaves where there is no room."""
        kind = type(held.skeleton)
        order, number = self._in_memory.setdefault(kind, OrderedDict()), id(held)
        if number not in order:
            order[number] = weakref.ref(held, lambda _: order.pop(number, None))
        order.move_to_end(number)
        while len(order) > kind.ROOM:
            _, oldest = order.popitem(last=False)
            if (leaving := oldest()) is not None:
                leaving.leave()

    def write(self, arrays: Sequence[ArrayLike]) -> int:
        """Append arrays; where they are.

        Raises:
            OSError: there is no room.
        """
        offset = self.size
        for array in (np.asarray(len(arrays)), *arrays):
            np.lib.format.write_array(self.file, np.asarray(array), allow_pickle=False)
        return offset

    def read(self, offset: int) -> list[NDArray]:
        """The arrays that were written there."""
        self.file.seek(offset)
        count = int(np.lib.format.read_array(self.file, allow_pickle=False))
        return [np.lib.format.read_array(self.file, allow_pickle=False) for _ in range(count)]


class Paged(Generic[V]):
    """One value, in memory or in a file.

    Attributes:
        skeleton: the value without its arrays.
        pages: where it goes.
    """

    def __init__(self, pages: PageFile, skeleton: V, value: V | None, offset: int | None) -> None:
        """By `PageFile.hold`, or from where a checkpoint says that it is."""
        self.skeleton, self.pages = skeleton, pages
        self._value, self._offset = value, offset

    @property
    def value(self) -> V:
        """The value, read where it had left."""
        value = self._value
        if value is None:
            assert self._offset is not None
            self._value = value = self.skeleton.with_stored(self.pages.read(self._offset))
        self.pages.touch(self)
        return value

    def written(self) -> int:
        """Where it is in the file, from now on at the latest.

        Raises:
            OSError: there is no room.
        """
        if self._offset is None:
            assert self._value is not None
            self._offset = self.pages.write(self._value.stored())
        return self._offset

    def leave(self) -> None:
        """Leave memory, unless the disk is full."""
        try:
            self.written()
        except OSError:
            return
        self._value = None
