"""Regions in which a hidden object may be, with their probabilities: "it may be here"."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

CELL_M = 0.05
"""Places nearer than a cell or two belong to one region: about the size of a hand-held object."""

NEIGHBOURS = 1.8
"""Cells apart that cells with a corner in common are, sqrt 3, and no others."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Region:
    """A part of space.

    Attributes:
        probability: that the object is there, its absence reckoned with.
        low_m, high_m: (3,) corners of what holds its middle.
    """

    probability: float
    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]


def regions_of(presence: float, middles_m: NDArray[np.float64]) -> list[Region]:
    """Groups of neighbouring cells that hold the object's middle in draws of its posterior, likeliest first.

    Args:
        presence: probability that the object is there.
        middles_m: (K, 3) of its box, in draws of the posterior given that it is there.
    """
    if not len(middles_m):
        return []
    cells, cell = np.unique(middles_m // CELL_M, axis=0, return_inverse=True)
    beside = KDTree(cells).sparse_distance_matrix(KDTree(cells), NEIGHBOURS)
    count, groups = connected_components(beside, directed=False)
    group = groups[cell.ravel()]
    regions = [
        Region(
            probability=presence * float((group == number).mean()),
            low_m=middles_m[group == number].min(axis=0),
            high_m=middles_m[group == number].max(axis=0),
        )
        for number in range(count)
    ]
    return sorted(regions, key=lambda region: -region.probability)
