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
    KEPT_MAPS,
    _best,
    _improved_singly,
    _PartialMap,
    place_best_first,
)
from slam.map_hypotheses.cross_registration import KeyframeRegistrar

RING = (0, 3, 1, 4, 2, 5)
"""The keyframes as they stand on a ring; neighbours see the same."""


@dataclass(frozen=True)
class _Optimum:
    pose: jnp.ndarray


@dataclass(frozen=True)
class _Place:
    """Where a keyframe was found, at (x, 0, 0), and the evidence for it."""

    x: float
    evidence: float
    is_finite = True

    @property
    def optimum(self) -> _Optimum:
        return _Optimum(jnp.array([1.0, 0, 0, 0, self.x, 0, 0]))


class RingJury:
    """Keyframe k stands at (k, 0, 0). Next to neighbours it is found there; else a wrong place beats none."""

    noise = DepthNoise()

    def __len__(self) -> int:
        return len(RING)

    def register_globally(
        self, poses: NDArray[np.float64], index: int, others: Sequence[int]
    ) -> list[_Place]:
        """The right place with 100 nats for every neighbour that stands right, a wrong one with 30."""
        at = RING.index(index)
        beside = {RING[at - 1], RING[(at + 1) % len(RING)]}
        right = sum(other in beside and abs(poses[other, 0, 3] - other) < 1e-6 for other in others)
        return [*([_Place(index, 100.0 * right)] if right else []), _Place(-5.0 - index, 30.0)]

    def register_locally(self, poses: NDArray[np.float64], index: int, others: Sequence[int]) -> _Place:
        """Where it is."""
        del others
        return _Place(float(poses[index, 0, 3]), 0.0)

    def all_but(self, index: int) -> list[int]:
        """The other keyframes."""
        return [other for other in range(len(RING)) if other != index]

    def log_composite(self, poses: NDArray[np.float64]) -> float:
        """Most where all stand right."""
        return -float(np.abs(poses[:, 0, 3] - np.arange(len(RING))).sum())


def test_the_surest_comes_next(monkeypatch: pytest.MonkeyPatch) -> None:
    """In their own order most keyframes would stand wrong: their neighbours come after them."""
    monkeypatch.setattr(best_first_search, "_log_evidence", lambda place, noise: place.evidence)  # noqa: ARG005

    placed = place_best_first(cast("KeyframeRegistrar", RingJury()))

    assert placed is not None
    np.testing.assert_allclose(placed[:, 0, 3], np.arange(len(RING)), atol=1e-6)


def test_what_stands_wrong_alone_is_moved() -> None:
    """Placed by few, one keyframe may stand wrong: in the map of all the others it is put right."""
    poses = np.tile(np.eye(4), (len(RING), 1, 1))
    poses[:, 0, 3] = np.arange(len(RING))
    poses[2, 0, 3] = -7.0

    improved = _improved_singly(cast("KeyframeRegistrar", RingJury()), poses)

    np.testing.assert_allclose(improved[:, 0, 3], np.arange(len(RING)), atol=1e-6)


def test_the_maps_of_most_evidence_are_kept_once() -> None:
    """The same keyframes in the same places are one map; in other places they are two, as of others."""
    moved = np.eye(4)
    moved[0, 3] = 1.0
    best = _PartialMap({0: np.eye(4), 1: moved}, 9.0, {})
    same, elsewhere, others = (
        _PartialMap({0: np.eye(4), 1: moved + 1e-4}, 8.0, {}),
        _PartialMap({0: np.eye(4), 1: np.eye(4)}, 7.0, {}),
        _PartialMap({0: np.eye(4), 2: moved}, 6.0, {}),
    )
    worst = [_PartialMap({0: np.eye(4), 3 + index: moved}, -float(index), {}) for index in range(KEPT_MAPS)]

    assert _best([*worst, others, same, elsewhere, best]) == [best, elsewhere, others, *worst][:KEPT_MAPS]
