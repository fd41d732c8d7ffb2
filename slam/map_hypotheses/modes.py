"""Several maps of the same keyframes with their probabilities, and what a search may not have found.

Where no start of a search leads to what another one has led to, there are more optima than starts, and the
true map may be none of those found: of twelve films of five views round an object three or more of six starts
reached the best map in the five where it was sure and right, and one or two in the seven where it was wrong
or unsure (docs/model.md, development films). What was not found is told by the maps that were found once.
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
        shares: (G,) their probabilities.
        undiscovered: probability that another start would have found another map.
    """

    maps: NDArray[np.float64]
    shares: NDArray[np.float64]
    undiscovered: float

    @classmethod
    def of(
        cls, maps: Sequence[NDArray[np.float64]], log_weights: Sequence[float], searched: Sequence[int] = ()
    ) -> Modes:
        """Those of distinct maps (N, 4, 4) that are not negligible; of maps that are alike the likeliest.

        A weight that is no number counts for nothing; where all are none, maps are equally likely. The
        probability that another start would have found another map goes to those found once, for they stand
        for it, and to the likeliest, which stays so.

        Args:
            maps: that are compared.
            log_weights: theirs.
            searched: which of the maps starts of one search have led to.
        """
        known = np.where(np.isfinite(log_weights), np.asarray(log_weights, np.float64), -np.inf)
        if np.isneginf(known).all():
            known = np.zeros(len(maps))
        kept: list[int] = []
        times_found: list[int] = []
        for index in np.argsort(-known, kind="stable").tolist():
            alike = (n for n, other in enumerate(kept) if within_reach(maps[index], maps[other]).all())
            if (number := next(alike, None)) is None:
                number = len(kept)
                kept.append(index)
                times_found.append(0)
            times_found[number] += index in searched
        weights, found = known[kept], np.asarray(times_found)
        shares = np.exp(weights - np.logaddexp.reduce(weights))
        standing = (found == 1) | (np.arange(len(kept)) == 0)
        missed = undiscovered_share(found)
        shares = (1.0 - missed) * shares + missed * standing / standing.sum()
        enough = np.sort(np.argsort(-shares, kind="stable")[:MAX_CLUSTERS])
        enough = enough[shares[enough] >= LEAST_PROBABILITY]
        return cls(np.stack(maps)[kept][enough], shares[enough] / shares[enough].sum(), missed)


def undiscovered_share(times_found: NDArray[np.integer]) -> float:
    """Probability that one more start finds what none has found; Chao and Jost 2012, equation 4a.

    Of n starts f1 found something that no other one found, f2 something that one other found. It is Good's
    f1 / n (1953) with less bias where starts are few; nothing is said by fewer than two.
    """
    starts, once, twice = times_found.sum(), (times_found == 1).sum(), (times_found == 2).sum()
    if starts < 2 or not once:
        return 0.0
    pairs = (starts - 1) * (once if twice else once - 1)
    return float(once / starts * pairs / (pairs + 2 * max(twice, 1)))
