"""The colour images that belong to depth frames: the nearest in time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, TypeVar

Item = TypeVar("Item")

TOLERANCE_NS = 20_000_000
"""Farther apart, a hand-held camera has moved on (the tolerance of TUM's associate.py)."""


class NearestInTime(Generic[Item]):
    """Looks up the item nearest to each of increasing times, in a stream by increasing time."""

    def __init__(self, items: Iterator[tuple[int, Item]]) -> None:
        self._items = items
        self._before: tuple[int, Item] | None = None
        self._after = next(items, None)

    def at(self, time_ns: int) -> Item | None:
        """The nearest item within `TOLERANCE_NS`, or None."""
        while self._after is not None and self._after[0] < time_ns:
            self._before, self._after = self._after, next(self._items, None)
        found = [item for item in (self._before, self._after) if item is not None]
        if not found:
            return None
        nearest_ns, item = min(found, key=lambda candidate: abs(candidate[0] - time_ns))
        return item if abs(nearest_ns - time_ns) <= TOLERANCE_NS else None
