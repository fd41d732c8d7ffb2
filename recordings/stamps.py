"""Putting frames in the order of their stamps, and choosing those that the user wants."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from itertools import count
from typing import TypeVar

from recordings.options import ReadOptions

Item = TypeVar("Item")

_WINDOW = 8
"""Frames that are held back so that one that comes late still finds its place."""
_SECOND_NS = 1_000_000_000
_END_OF_TIME_NS = 1 << 62
"""The year 2116: later stamps are damage, and those of all frames fit into 64 bits."""


def is_of_this_age(time_ns: int) -> bool:
    """Whether a stamp or a log time can be one: damage makes any number of it."""
    return 0 <= time_ns < _END_OF_TIME_NS


def in_order_of_stamps(
    items: Iterable[tuple[int, Item]], leave_out: Callable[[int], None]
) -> Iterator[tuple[int, Item]]:
    """Items by increasing stamp; one that comes too late, or repeats a stamp, goes to `leave_out`."""
    arrival = count()
    held: list[tuple[int, int, Item]] = []
    last: int | None = None
    for stamp, item in items:
        if last is not None and stamp <= last:
            leave_out(stamp)
            continue
        heapq.heappush(held, (stamp, next(arrival), item))
        if len(held) <= _WINDOW:
            continue
        stamp, _, item = heapq.heappop(held)
        if stamp == last:
            leave_out(stamp)
            continue
        last = stamp
        yield stamp, item
    while held:
        stamp, _, item = heapq.heappop(held)
        if stamp == last:
            leave_out(stamp)
            continue
        last = stamp
        yield stamp, item


def selected(
    items: Iterable[tuple[int, Item]], options: ReadOptions, is_usable: Callable[[Item], bool]
) -> Iterator[tuple[int, Item]]:
    """The usable items between the options' times, counted from the first item, and of those every n-th."""
    start: int | None = None
    within = 0
    for stamp, item in items:
        if start is None:
            start = stamp
        seconds = (stamp - start) / _SECOND_NS
        if seconds > options.end_s:
            return
        if seconds >= options.start_s and is_usable(item):
            if within % options.every == 0:
                yield stamp, item
            within += 1
