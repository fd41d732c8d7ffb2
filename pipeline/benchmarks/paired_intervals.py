"""How much better one column is than another on the same images, with a 95% interval over images.

Objects of one image share its difficulty, so images, not objects, are what is drawn at random: the
difference of shares is a ratio of sums over images, and its variance that of a ratio estimator (Cochran
1977, section 6.3). Half a pair of opposite wins is added on either side, after Agresti and Min (2005), so
that few images, or columns that never differ, do not seem certain.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import t as student

Object = TypeVar("Object", bound=Hashable)

LEVEL = 0.95
ADDED = 2.0
"""Objects that are added: half a win of either column, and a tie."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Share of the first column that is right less that of the second.

    Attributes:
        share: the difference as counted.
        low: lower end of the 95% interval.
        high: upper end.
        images: on which both were tried.
        objects: likewise.
    """

    share: float
    low: float
    high: float
    images: int
    objects: int


def paired_difference(
    first: Sequence[bool], second: Sequence[bool], images: Sequence[Hashable]
) -> Difference | None:
    """The difference of two columns; None where there is nothing to compare.

    Args:
        first: (N,) whether each object is right in the first column.
        second: (N,) the same in the second.
        images: (N,) the image of each object.
    """
    if not len(images):
        return None
    sums: dict[Hashable, list[float]] = {}
    for one, other, image in zip(first, second, images, strict=True):
        total = sums.setdefault(image, [0.0, 0.0])
        total[0] += float(one) - float(other)
        total[1] += 1.0
    differences, counts = np.array(list(sums.values())).T
    low, high = interval(differences, counts)
    return Difference(
        share=float(differences.sum() / counts.sum()),
        low=low,
        high=high,
        images=len(counts),
        objects=int(counts.sum()),
    )


def interval(differences: ArrayLike, counts: ArrayLike) -> tuple[float, float]:
    """95% interval of the sum of differences over the sum of counts, over images (M,)."""
    difference, count = np.asarray(differences, np.float64), np.asarray(counts, np.float64)
    total = count.sum() + ADDED
    middle = difference.sum() / total
    residuals = ((difference - middle * count) ** 2).sum()
    residuals += 0.5 * (1 - middle) ** 2 + 0.5 * (1 + middle) ** 2 + middle**2
    images = len(count) + ADDED
    spread = np.sqrt(residuals * images / (images - 1)) / total
    reach = float(student.ppf((1 + LEVEL) / 2, images - 1) * spread)
    return max(float(middle) - reach, -1.0), min(float(middle) + reach, 1.0)


def compared(
    rows: Mapping[str, Mapping[Object, bool]], first: str, second: str, images: Mapping[Object, Hashable]
) -> Difference | None:
    """The difference of two named columns on the objects that both have.

    Args:
        rows: by column, whether each object is right.
        first: a column.
        second: another.
        images: of the objects.
    """
    shared = [one for one in rows[first] if one in rows[second]]
    return paired_difference(
        [rows[first][one] for one in shared],
        [rows[second][one] for one in shared],
        [images[one] for one in shared],
    )
