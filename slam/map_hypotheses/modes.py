"""Several maps of the same keyframes with their probabilities, and what a search may not have found.

Where no start of a search leads to what another one has led to, there are more optima than starts, and the
true map may be none of those found: of twelve films of five views round an object three or more of six starts
reached the best map in the five where it was sure and right, and one or two in the seven where it was wrong
or unsure (docs/model.md, development films).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapes.geometry.pose_sets import MAX_CLUSTERS, within_reach
from slam.config import LEAST_PROBABILITY


@dataclass(frozen=True)
class Modes:
    """Maps that are left.

    Attributes:
        maps: (G, N, 4, 4) reference_from_keyframe, the likeliest first.
        shares: (G,) their probabilities, given that the true one is among them.
        undiscovered: probability that a further start of the search would have found another map.
    """

    maps: NDArray[np.float64]
    shares: NDArray[np.float64]
    undiscovered: float

    @classmethod
    def of(
        cls,
        maps: Sequence[NDArray[np.float64]],
        log_weights: Sequence[float],
        searched: Sequence[int] | None = None,
    ) -> Modes:
        """Those of distinct maps (N, 4, 4) that are not negligible; of maps that are alike the likeliest.

        A weight that is no number counts for nothing; where all are none, maps are equally likely.

        Args:
            maps: that are compared.
            log_weights: theirs.
            searched: which of the maps starts of one search have led to; None where none was made.
        """
        known = np.where(np.isfinite(log_weights), np.asarray(log_weights, np.float64), -np.inf)
        if np.isneginf(known).all():
            known = np.zeros(len(maps))
        kept: list[int] = []
        number_of: dict[int, int] = {}
        for index in np.argsort(-known, kind="stable").tolist():
            alike = (n for n, other in enumerate(kept) if within_reach(maps[index], maps[other]).all())
            number_of[index] = next(alike, len(kept))
            if number_of[index] == len(kept):
                kept.append(index)
        weights = known[kept]
        shares = np.exp(weights - np.logaddexp.reduce(weights))
        enough = (shares >= LEAST_PROBABILITY) & (np.arange(len(kept)) < MAX_CLUSTERS)
        undiscovered = 0.0
        if searched is not None:
            reached = [number_of[index] for index in searched if np.isfinite(known[index])]
            undiscovered = undiscovered_share(np.bincount(np.asarray(reached, int)))
        return cls(np.stack(maps)[kept][enough], shares[enough] / shares[enough].sum(), undiscovered)


def undiscovered_share(times_found: NDArray[np.integer]) -> float:
    """Probability that one more start finds what none has found; Chao and Jost 2012, equation 4a.

    Of n starts f1 found something that no other one found, f2 something that one other found. It is Good's
    f1 / n (1953) with less bias where starts are few. Starts are taken for independent draws; those that are
    chosen to differ find more things once, so that rather too much is told. Of fewer than two nothing is
    known, and all is open.

    Args:
        times_found: how often each thing was found, zeros or not.
    """
    starts, once, twice = times_found.sum(), (times_found == 1).sum(), (times_found == 2).sum()
    if starts < 2:
        return 1.0
    if not once:
        return 0.0
    pairs = (starts - 1) * (once if twice else once - 1)
    return float(once / starts * pairs / (pairs + 2 * max(twice, 1)))
