"""A handful of views: whole maps are compared, and what stands wrong alone is sought again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import cast

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from slam.map_hypotheses import spanning_trees
from slam.map_hypotheses.cross_registration import KeyframeRegistrar
from slam.map_hypotheses.spanning_trees import (
    KEPT_MAPS,
    Tree,
    Ways,
    _label_parts,
    _place,
    _propose_exchanges,
    _seek_contradicting,
    _take_distinct,
    place_by_spanning_trees,
)

RING = (0, 3, 1, 4, 2, 5)
"""The keyframes as they stand on a ring; neighbours see the same."""

PER_NEIGHBOUR, MISLEADING = 100.0, 130.0
"""Nats: for a neighbour that stands right, and for a keyframe that stands wrong beside the first alone."""

WRONG_M = 7.0
"""To the left of the first, where others stand that are registered with it wrongly."""


@dataclass(frozen=True)
class _Optimum:
    pose: jnp.ndarray


@dataclass(frozen=True)
class _Place:
    """Where a keyframe was found, at (x, 0, 0), and whether its neighbours agree."""

    x: float
    agrees: bool
    is_finite = True
    covered = 1.0

    @property
    def explained(self) -> float:
        """All or half."""
        return 1.0 if self.agrees else 0.5

    @property
    def optimum(self) -> _Optimum:
        return _Optimum(jnp.array([1.0, 0, 0, 0, self.x, 0, 0]))


class RingJury:
    """Keyframe k stands at (k, 0, 0). Neighbours are registered there, and in a wrong place.

    Others are registered in a wrong place alone. Beside the first that has more evidence than a right one.
    """

    def __len__(self) -> int:
        return len(RING)

    def _neighbours(self, index: int) -> set[int]:
        at = RING.index(index)
        return {RING[at - 1], RING[(at + 1) % len(RING)]}

    def _right(self, places: dict[int, float], index: int) -> int:
        """Neighbours among those at these places beside which a keyframe stands right."""
        beside = self._neighbours(index) & places.keys()
        return sum(abs(places[index] - places[other] - (index - other)) < 1e-6 for other in beside)

    def register_globally(
        self, poses: NDArray[np.float64], index: int, others: Sequence[int]
    ) -> list[_Place]:
        """A wrong place, and where neighbours say."""
        places = {other: float(poses[other, 0, 3]) for other in others}
        wrong = _Place(places[others[0]] - WRONG_M, agrees=False)
        found = sorted({places[other] + index - other for other in self._neighbours(index) & places.keys()})
        return [wrong, *(_Place(x, agrees=True) for x in found)]

    def register_locally(self, poses: NDArray[np.float64], index: int, others: Sequence[int]) -> _Place:
        """Where it is."""
        places = {other: float(poses[other, 0, 3]) for other in [*others, index]}
        return _Place(places[index], self._right(places, index) > 0)

    def log_scores(
        self, poses: NDArray[np.float64], judged: Sequence[int], blur: float
    ) -> NDArray[np.float64]:
        """For neighbours that stand right, and one that stands wrong beside the first."""
        del blur
        maps = [dict(enumerate(one[:, 0, 3].tolist())) for one in poses]
        misled = [any(abs(places[k] - places[0] + WRONG_M) < 1e-6 for k in judged) for places in maps]
        right = [sum(self._right(places, index) for index in judged) for places in maps]
        return PER_NEIGHBOUR * np.asarray(right) + MISLEADING * np.asarray(misled)

    def all_but(self, index: int) -> list[int]:
        """The other keyframes."""
        return [other for other in range(len(RING)) if other != index]

    def log_composite(self, poses: NDArray[np.float64]) -> float:
        """Most where all stand right."""
        return float(self.log_composite_of_blocks(poses).sum())

    def log_composite_of_blocks(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """The same, a block for each keyframe."""
        return -np.abs(poses[:, :1, 3] - np.arange(len(RING))[:, None])


def unsettled(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """A map as it is."""
    return poses


def of_any_motion(poses: NDArray[np.float64]) -> float:
    """A prior that all maps have."""
    del poses
    return 0.0


def some_ways(count: int, each: int) -> Ways:
    """So many ways between all pairs, a metre apart."""
    ways: Ways = {}
    for first, second in combinations(range(count), 2):
        ways[first, second] = [np.eye(4) for _ in range(each)]
        for number, way in enumerate(ways[first, second]):
            way[0, 3] = second - first + number
        ways[second, first] = [np.linalg.inv(way).astype(np.float64) for way in ways[first, second]]
    return ways


def all_trees(ways: Ways, count: int) -> set[Tree]:
    """Every spanning tree with every way, by brute force."""
    trees = set()
    for pairs in combinations(combinations(range(count), 2), count - 1):
        numbers = product(*(range(len(ways[pair])) for pair in pairs))
        if len(set(_label_parts([(*pair, 0) for pair in pairs], count))) == 1:
            trees |= {
                frozenset((*pair, number) for pair, number in zip(pairs, some, strict=True))
                for some in numbers
            }
    return trees


@pytest.mark.parametrize("seed", range(3))
def test_whole_maps_decide(seed: int) -> None:
    """Beside the first keyframe wrong places have most evidence; of all keyframes the ring has."""
    placed = place_by_spanning_trees(
        cast("KeyframeRegistrar", RingJury()), unsettled, of_any_motion, np.random.default_rng(seed)
    )

    assert 1 <= len(placed) <= 2 * KEPT_MAPS
    np.testing.assert_allclose(placed[0][:, 0, 3], np.arange(len(RING)), atol=1e-6)


@pytest.mark.parametrize(("nats", "is_left"), [(1e3, True), (0.0, False)])
def test_motion_counts_in_whole_maps(nats: float, is_left: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A prior that wants the second keyframe on the left has it there, against all images."""
    monkeypatch.setattr(spanning_trees, "_improve", lambda registrar, settle, poses: poses)  # noqa: ARG005

    def log_prior(poses: NDArray[np.float64]) -> float:
        return nats * float(poses[1, 0, 3] < 0)

    placed = place_by_spanning_trees(
        cast("KeyframeRegistrar", RingJury()), unsettled, log_prior, np.random.default_rng(0)
    )

    assert (placed[0][1, 0, 3] < 0) == is_left


def test_without_ways_there_is_no_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """A keyframe that was registered with no other leaves no spanning tree."""
    ways = some_ways(len(RING), 1)
    for other in range(1, len(RING)):
        ways[0, other] = ways[other, 0] = []
    monkeypatch.setattr(spanning_trees, "_register_pairs", lambda registrar: ways)  # noqa: ARG005

    assert not place_by_spanning_trees(
        cast("KeyframeRegistrar", RingJury()), unsettled, of_any_motion, np.random.default_rng(0)
    )


def test_an_exchange_is_a_gibbs_step() -> None:
    """A cut's options are the same from each of them, and one at least leads to every tree.

    So drawing one in proportion to any weights leaves these invariant: 4 keyframes, 2 ways, 128 trees.
    """
    ways = some_ways(4, 2)
    trees = all_trees(ways, 4)
    assert len(trees) == 16 * 2**3
    reached = set()
    for tree in trees:
        for cut in tree:
            options = {other for other in trees if tree - {cut} <= other}
            drawn = next(
                found
                for seed in range(200)
                if len(found := _propose_exchanges(tree, ways, 4, np.random.default_rng(seed)))
                == len(options)
                and set(found) == options
            )
            assert drawn[0] == tree
            assert len(set(drawn)) == len(drawn)
            reached |= options - {tree}

    assert reached == trees


def test_a_tree_places_each_keyframe_beside_its_neighbour() -> None:
    """Whatever the order of its edges and their direction, from the first keyframe."""
    ways = some_ways(4, 2)

    placed = _place(frozenset({(2, 3, 1), (0, 3, 0), (1, 2, 1)}), ways, 4)

    # 3 is at 3; 2 a way of 2 m before it; 1 a way of 2 m before that.
    np.testing.assert_allclose(placed[:, 0, 3], [0.0, -1.0, 1.0, 3.0])


def test_what_stands_wrong_alone_is_moved() -> None:
    """Placed by few, one keyframe may stand wrong: in the map of all the others it is put right."""
    poses = np.tile(np.eye(4), (len(RING), 1, 1))
    poses[:, 0, 3] = np.arange(len(RING))
    poses[2, 0, 3] = -WRONG_M

    found = _seek_contradicting(cast("KeyframeRegistrar", RingJury()), poses)

    np.testing.assert_allclose(found[:, 0, 3], np.arange(len(RING)), atol=1e-6)


def test_maps_that_are_alike_are_one() -> None:
    """A tenth of a millimetre is the same place; one keyframe elsewhere is another map."""
    best = np.tile(np.eye(4), (3, 1, 1))
    same, elsewhere = best + 1e-4, best.copy()
    elsewhere[2, 1, 3] = 1.0

    assert _take_distinct([best, same, elsewhere, best], 3) == [best, elsewhere]
    assert len(_take_distinct([best, elsewhere], 1)) == 1
