"""Names of several objects of one shape."""

from __future__ import annotations

import re
from collections.abc import Container, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

COPY = re.compile(r"(.+)_[0-9]+$")

MOST_COPIES = 8
"""Of one shape: every copy is searched for by itself."""


def asked_copies(entry: str) -> tuple[str, int]:
    """Name and number of copies of `mug` or `mug:3`.

    Raises:
        ValueError: the number is none, or too large.
    """
    name, separator, number = entry.partition(":")
    if not separator:
        return name, 1
    if not number.isdecimal() or not 1 <= int(number) <= MOST_COPIES:
        raise ValueError(f"objects: {entry!r} must ask for 1 to {MOST_COPIES} copies, such as {name}:2")
    return name, int(number)


def slot_names(names: Sequence[str], copies: int) -> list[str]:
    """Of every copy of every kind: mug, mug_2, mug_3."""
    return [name if copy == 0 else f"{name}_{copy + 1}" for name in names for copy in range(copies)]


def copies_among(points_m: Mapping[str, NDArray[np.floating]]) -> NDArray[np.bool_]:
    """(N, N) which objects are of one shape, each one with itself: by their names and surfaces.

    Other shapes may be named alike: box and box_2.

    Args:
        points_m: of each object's surface, in its own frame, by its name.
    """
    points = list(points_m.values())
    shapes = np.array([_first_of(name, points_m) for name in points_m])
    alike = shapes[:, None] == shapes[None]
    for one, other in np.argwhere(alike):
        alike[one, other] = np.array_equal(points[one], points[other])
    return alike


def shape_of(name: str, shapes: Container[str]) -> str:
    """The one of these shapes that an object is a copy of by its name; the name itself where it is none."""
    copy = COPY.match(name)
    return copy[1] if name not in shapes and copy and copy[1] in shapes else name


def _first_of(name: str, names: Container[str]) -> str:
    """The name without what makes it a copy of another one of these, and so on: box of box_2_2 and box_2."""
    copy = COPY.match(name)
    return _first_of(copy[1], names) if copy and copy[1] in names else name
