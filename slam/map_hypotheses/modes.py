"""Several maps of the same keyframes with their probabilities."""

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
    """

    maps: NDArray[np.float64]
    shares: NDArray[np.float64]

    @classmethod
    def of(cls, maps: Sequence[NDArray[np.float64]], log_weights: Sequence[float]) -> Modes:
        """Those of distinct maps (N, 4, 4) that are not negligible; of maps that are alike the likeliest.

        A weight that is no number counts for nothing; where all are none, maps are equally likely.
        """
        known = np.where(np.isfinite(log_weights), np.asarray(log_weights, np.float64), -np.inf)
        if np.isneginf(known).all():
            known = np.zeros(len(maps))
        kept: list[int] = []
        for index in np.argsort(-known, kind="stable").tolist():
            if not any(within_reach(maps[index], maps[other]).all() for other in kept):
                kept.append(index)
        weights = known[kept]
        shares = np.exp(weights - np.logaddexp.reduce(weights))
        enough = (shares >= LEAST_PROBABILITY) & (np.arange(len(kept)) < MAX_CLUSTERS)
        return cls(np.stack(maps)[kept][enough], shares[enough] / shares[enough].sum())
