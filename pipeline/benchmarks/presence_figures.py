"""Are shapes that are not there told from those that are? Counts by what was said of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

BOUNDS = (0.05, 0.5, 0.9, 0.98)
"""Between the bins of presence."""
RIGHT_M = 0.01
"""Errors under this count as right."""
VISIBLE = 0.25
"""Whether an object is there is not asked where less of it is seen."""


@dataclass(frozen=True, kw_only=True)
class Reported:
    """What was said of one shape that was asked for.

    Attributes:
        shape: its name.
        presence: the probability that was told.
        there: whether it is on the table and enough of it is seen.
        error_m: ADD-S where it is there, found or not, else infinite.
    """

    shape: str
    presence: float
    there: bool
    error_m: float

    @property
    def found(self) -> bool:
        """Whether it was said to be there."""
        return self.presence >= 0.5

    @property
    def right(self) -> bool:
        """Whether it is there, and, if it was found, where it was said to be."""
        return self.there and (not self.found or self.error_m < RIGHT_M)


def presence_figures(reported: Sequence[Reported]) -> dict[str, Any]:
    """Counts, and for every bin of presence that holds some how many were right."""
    places = np.digitize([one.presence for one in reported], BOUNDS)
    rows = [
        [reported[one] for one in np.flatnonzero(places == place).tolist()] for place in np.unique(places)
    ]
    return {
        "asked": len(reported),
        "absent": sum(not one.there for one in reported),
        "false": sum(one.found and not one.right for one in reported),
        "missed": sum(one.there and not one.found for one in reported),
        "calibration": [
            {
                "count": len(row),
                "presence": float(np.mean([one.presence for one in row])),
                "right": float(np.mean([one.right for one in row])),
            }
            for row in rows
        ],
    }
