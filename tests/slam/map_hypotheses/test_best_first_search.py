"""A handful of views: the surest comes next whatever its number, and partial maps that are alike are one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from recordings.types import DepthNoise
from slam.map_hypotheses import best_first_search
from slam.map_hypotheses.best_first_search import (
    COMPLETE_MAPS,
    KEPT_MAPS,
    PartialMap,
    _improved_singly,
    _surest,
    place_best_first,
)
from slam.map_hypotheses.cross_registration import KeyframeRegistrar

RING = (0, 3, 1, 4, 2, 5)
"""The keyframes as they stand on a ring; neighbours see the same."""

PER_NEIGHBOUR, WRONG, MISLEADING = 100.0, 30.0, 130.0
"""Nats: for a neighbour that stands right, for a wrong place, and for one beside the first keyframe."""


@dataclass(frozen=True)
class _Optimum:
    pose: jnp.ndarray


@dataclass(frozen=True)
class _Place:
    """Where a keyframe was found, at (x, 0, 0), and the evidence for it."""

    x: float
    evidence: float
    is_finite = True
    is_plausible = True

    @property
    def optimum(self) -> _Optimum:
        return _Optimum(jnp.array([1.0, 0, 0, 0, self.x, 0, 0]))


class RingJury:
    """Keyframe k stands at (k, 0, 0). Beside neighbours it is found there; else wrong places beat none.

    Beside the first keyframe those that are no neighbours have most evidence of all, in wrong places.
    """

    noise = DepthNoise()

    def __len__(self) -> int:
        return len(RING)

    def _right(self, places: dict[int, float], index: int) -> float:
        """Evidence for a keyframe among those at these places."""
        at = RING.index(index)
        beside = {RING[at - 1], RING[(at + 1) % len(RING)]} & places.keys()
        return PER_NEIGHBOUR * sum(
            abs(places[index] - places[other] - (index - other)) < 1e-6 for other in beside
        )

    def register_globally(
        self, poses: NDArray[np.float64], index: int, others: Sequence[int]
    ) -> list[_Place]:
        """The right place where neighbours stand right, and a wrong one."""
        places = {other: float(poses[other, 0, 3]) for other in others}
        found = {places[other] + index - other for other in others}
        right = [_Place(x, self._right({**places, index: x}, index)) for x in sorted(found)]
        wrong = MISLEADING if list(others) == [0] and not right[0].evidence else WRONG
        return [*(place for place in right if place.evidence), _Place(-5.0 - index, wrong)]

    def register_locally(self, poses: NDArray[np.float64], index: int, others: Sequence[int]) -> _Place:
        """Where it is."""
        places = {other: float(poses[other, 0, 3]) for other in [*others, index]}
        return _Place(places[index], self._right(places, index))

    def log_scores(
        self, keyframes: Sequence[int], poses: NDArray[np.float64], judged: Sequence[int], blur: float
    ) -> NDArray[np.float64]:
        """As much as the evidence."""
        del blur
        maps = [dict(zip(keyframes, one[:, 0, 3].tolist(), strict=True)) for one in poses]
        return np.asarray([sum(self._right(places, index) for index in judged) for places in maps])

    def log_score_of_unknown(self, index: int, blur: float) -> float:
        """None."""
        del index, blur
        return 0.0

    def all_but(self, index: int) -> list[int]:
        """The other keyframes."""
        return [other for other in range(len(RING)) if other != index]

    def log_composite(self, poses: NDArray[np.float64]) -> float:
        """Most where all stand right."""
        return -float(np.abs(poses[:, 0, 3] - np.arange(len(RING))).sum())


def test_the_surest_pairs_come_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the first keyframe on most would stand wrong: their neighbours come after them."""
    monkeypatch.setattr(best_first_search, "_log_evidence", lambda place, noise: place.evidence)  # noqa: ARG005

    placed = place_best_first(cast("KeyframeRegistrar", RingJury()), lambda log_evidence, _: log_evidence)

    np.testing.assert_allclose(placed[0][:, 0, 3], np.arange(len(RING)), atol=1e-6)


def test_whole_maps_are_told_apart_by_their_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against all evidence the prior wants the last keyframe far to the left: those maps are settled."""
    monkeypatch.setattr(best_first_search, "_log_evidence", lambda place, noise: place.evidence)  # noqa: ARG005
    monkeypatch.setattr(best_first_search, "_settled", lambda registrar, poses: poses)  # noqa: ARG005
    monkeypatch.setattr(best_first_search, "_improved_singly", lambda registrar, poses: poses)  # noqa: ARG005
    asked: list[tuple[float, float]] = []

    def log_weight(log_evidence: float, poses: NDArray[np.float64]) -> float:
        asked.append((float(poses[-1, 0, 3]), log_evidence))
        return log_evidence - 1e3 * float(poses[-1, 0, 3])

    placed = place_best_first(cast("KeyframeRegistrar", RingJury()), log_weight)

    leftmost = sorted({x for x, _ in asked})
    assert min(one[-1, 0, 3] for one in placed) == leftmost[0] < max(asked, key=lambda one: one[1])[0]
    assert len(placed) <= COMPLETE_MAPS


def test_what_stands_wrong_alone_is_moved() -> None:
    """Placed by few, one keyframe may stand wrong: in the map of all the others it is put right."""
    poses = np.tile(np.eye(4), (len(RING), 1, 1))
    poses[:, 0, 3] = np.arange(len(RING))
    poses[2, 0, 3] = -7.0

    improved = _improved_singly(cast("KeyframeRegistrar", RingJury()), poses)

    np.testing.assert_allclose(improved[:, 0, 3], np.arange(len(RING)), atol=1e-6)


def test_the_maps_of_most_evidence_are_kept_once() -> None:
    """The same keyframes in the same places from the first are one map; others are two."""
    moved = np.eye(4)
    moved[0, 3] = 1.0
    best = PartialMap({0: np.eye(4), 1: moved}, 9.0)
    same, elsewhere, others = (
        PartialMap({1: moved @ moved, 0: moved + 1e-4}, 8.0),
        PartialMap({0: np.eye(4), 1: np.eye(4)}, 7.0),
        PartialMap({0: np.eye(4), 2: moved}, 6.0),
    )
    worst = [PartialMap({0: np.eye(4), 3 + index: moved}, -float(index)) for index in range(KEPT_MAPS)]

    assert _surest([*worst, others, same, elsewhere, best]) == [best, elsewhere, others, *worst][:KEPT_MAPS]
