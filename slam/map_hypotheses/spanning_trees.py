"""Whole maps from spanning trees of pairwise registrations, drawn by annealing.

Views a third of a circle apart share little, and round an object that looks alike from many sides a pair of
views fits in many ways. Every pair of keyframes is registered, which gives a few ways for each. Any spanning
tree of the pairs, with one way for each of its edges, places all keyframes. A partial map is no guide to the
whole: of five views round an object the true places of three had less evidence than wrong ones, and the true
map of all five had 1,194 nats more than any that such partial maps grew into (docs/model.md, development
films). So only whole maps are compared: trees are drawn in proportion to exp(score / temperature) by edge
exchange, a Gibbs step (an edge is cut, and the two parts are joined by another way), while the temperature
falls (simulated annealing, Kirkpatrick, Gelatt and Vecchi 1983).

The score of a tree is approximate: surfaces are blurred. The best maps that differ are brought to their
optimum and compared by the composite likelihood of all images. Keyframes that contradict the best of these
are sought again in the map of all others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from shapes.geometry.poses import matrices_of
from slam.map_hypotheses.cross_registration import (
    CONSISTENT_INLIER_RATIO,
    KeyframeRegistrar,
    inlier_ratio,
)
from slam.map_hypotheses.map_odds import log_odds
from slam.registration.registered import SAME_SHIFT_M, Registration

CHAINS, COMPARED = 32, 50_000
"""Trees that are drawn at once, and trees that all exchanges together choose from. Search effort: of the 32
best maps that differ, by enumeration of all 140,000 trees of five views, they find 25 to 32 (two films of
objects, four seeds each)."""

EXCHANGES = 32
"""Ways between two parts that one exchange chooses from, the present one among them. Search effort."""

HOTTEST, COLDEST = 60.0, 10.0
"""Nats. One in a thousand trees of five views is 50 to 100 behind the best (three films of objects)."""

BLUR = 0.015
"""Relative to depth, of the surfaces by which trees are compared. Ways are up to a centimetre off, and a tree
of four adds them up; with twice that blur a view that is turned by a quarter circle fits as well."""

SCORED_MAPS, DRAWN_MAPS, KEPT_MAPS = 128, 32, 3
"""Maps of the highest scores whose motion is weighed, draws of these that are settled, and maps that are
improved, with the motion and without: one wrong keyframe spoils it. Search effort."""

PLACES = 3
"""Of each keyframe in the map of all others."""

SETTLING_SWEEPS = 3
"""Search effort."""

IMPROVEMENTS = 3
"""Rounds in which keyframes that contradict a map are sought again. Search effort."""

LEAST_GAIN = 1.0
"""Nats: less is how far an optimum was followed."""

Ways = dict[tuple[int, int], list[NDArray[np.float64]]]
"""By two keyframes: poses first_from_second (4, 4) where the one may stand beside the other."""

Edge = tuple[int, int, int]
"""Two keyframes, the first the smaller number, and the number of a way between them."""

Tree = frozenset[Edge]
"""Edges that join all keyframes, one fewer than these."""


def place_by_spanning_trees(
    registrar: KeyframeRegistrar,
    settle: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    log_prior: Callable[[NDArray[np.float64]], float],
    rng: np.random.Generator,
) -> list[NDArray[np.float64]]:
    """Poses (N, 4, 4) of all keyframes from the first: maps that differ, none where ways do not join them.

    Args:
        registrar: the keyframes.
        settle: brings a map (N, 4, 4) to its joint optimum.
        log_prior: of a map's motion.
        rng: of the draws; used.
    """
    ways = _register_pairs(registrar)
    maps = [_align_in_turn(registrar, poses) for poses in _draw_maps(registrar, ways, log_prior, rng)]
    if not maps:
        return []
    blocks = np.stack([registrar.log_composite_of_blocks(poses) for poses in maps])
    composites = blocks.sum(axis=(1, 2))
    weights = log_odds(blocks) + [log_prior(poses) for poses in maps]
    likeliest, most_agreed = (
        _take_distinct((maps[index] for index in np.argsort(-values)), KEPT_MAPS)
        for values in (weights, composites)
    )
    kept = _take_distinct([*likeliest, *most_agreed], 2 * KEPT_MAPS)
    return [_improve(registrar, settle, poses) for poses in kept]


def _register_pairs(registrar: KeyframeRegistrar) -> Ways:
    """The ways between all pairs of keyframes, in both directions."""
    ways: Ways = {}
    alone = np.tile(np.eye(4), (len(registrar), 1, 1))
    for first, second in combinations(range(len(registrar)), 2):
        places = registrar.register_globally(alone, second, [first])
        ways[first, second] = [matrices_of(place.optimum.pose).astype(np.float64) for place in places]
        ways[second, first] = [np.linalg.inv(way).astype(np.float64) for way in ways[first, second]]
    return ways


def _draw_maps(
    registrar: KeyframeRegistrar,
    ways: Ways,
    log_prior: Callable[[NDArray[np.float64]], float],
    rng: np.random.Generator,
) -> list[NDArray[np.float64]]:
    """The `DRAWN_MAPS` likeliest that differ, of all that annealed chains considered.

    Round what looks alike from many sides the motion alone tells turned maps from the true one.
    """
    count = len(registrar)
    trees = [_draw_tree(ways, count, rng) for _ in range(CHAINS)]
    if len(trees[0]) < count - 1:
        return []
    scores: dict[Tree, float] = {}
    sweeps = max(COMPARED // (CHAINS * EXCHANGES * (count - 1)), 2)
    for temperature in np.geomspace(HOTTEST, COLDEST, sweeps):
        for _ in range(count - 1):
            options = [_propose_exchanges(tree, ways, count, rng) for tree in trees]
            new = list(dict.fromkeys(tree for some in options for tree in some if tree not in scores))
            scores |= zip(new, _score(registrar, [_place(tree, ways, count) for tree in new]), strict=True)
            trees = [
                max(some, key=lambda tree: scores[tree] / temperature + rng.gumbel()) for some in options
            ]
    ranked = sorted(scores, key=scores.__getitem__, reverse=True)
    maps = _take_distinct((_place(tree, ways, count) for tree in ranked), SCORED_MAPS)
    weights = np.asarray(_score(registrar, maps)) / COLDEST + [log_prior(poses) for poses in maps]
    return [maps[index] for index in np.argsort(-weights)[:DRAWN_MAPS]]


def _score(registrar: KeyframeRegistrar, maps: list[NDArray[np.float64]]) -> list[float]:
    """Approximate log densities of all images, each in the map of the others, for maps (N, 4, 4)."""
    if not maps:
        return []
    return registrar.log_scores(np.stack(maps), range(len(registrar)), BLUR).tolist()


def _draw_tree(ways: Ways, count: int, rng: np.random.Generator) -> Tree:
    """A spanning tree; fewer edges where the ways do not join all of the `count` keyframes."""
    tree: list[Edge] = []
    pairs = [pair for pair in combinations(range(count), 2) if ways[pair]]
    for index in rng.permutation(len(pairs)):
        first, second = pairs[index]
        parts = _label_parts(tree, count)
        if parts[first] != parts[second]:
            tree.append((first, second, int(rng.integers(len(ways[first, second])))))
    return frozenset(tree)


def _propose_exchanges(tree: Tree, ways: Ways, count: int, rng: np.random.Generator) -> list[Tree]:
    """The tree, and those that differ from it in one edge, drawn at random; `EXCHANGES` of them at most."""
    cut = sorted(tree)[int(rng.integers(len(tree)))]
    rest = tree - {cut}
    parts = _label_parts(rest, count)
    others = [
        (first, second, way)
        for first, second in combinations(range(count), 2)
        if parts[first] != parts[second]
        for way in range(len(ways[first, second]))
        if (first, second, way) != cut
    ]
    chosen = rng.permutation(len(others))[: EXCHANGES - 1]
    return [tree, *(rest | {others[index]} for index in chosen)]


def _label_parts(edges: Iterable[Edge], count: int) -> NDArray[np.int_]:
    """Numbers (N,) of the parts that edges leave the keyframes in."""
    parts = np.arange(count)
    for first, second, _ in edges:
        parts[parts == parts[second]] = parts[first]
    return parts


def _place(tree: Tree, ways: Ways, count: int) -> NDArray[np.float64]:
    """Poses (N, 4, 4) where a tree has the keyframes, from the first."""
    placed, left = {0: np.eye(4)}, sorted(tree)
    while left:
        first, second, way = edge = next(one for one in left if one[0] in placed or one[1] in placed)
        if first in placed:
            placed[second] = placed[first] @ ways[first, second][way]
        else:
            placed[first] = placed[second] @ ways[second, first][way]
        left.remove(edge)
    return np.stack([placed[index] for index in range(count)])


def _improve(
    registrar: KeyframeRegistrar,
    settle: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    poses: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The joint optimum, with keyframes that contradict it where all images agree with them more.

    The joint density has several optima within centimetres: it is climbed again from where each image agrees
    most with all the others, as long as all agree more.
    """
    poses = settle(poses)
    log_composite = registrar.log_composite(poses)
    for _ in range(IMPROVEMENTS):
        other = settle(_align_in_turn(registrar, _seek_contradicting(registrar, poses)))
        if not (log_other := registrar.log_composite(other)) > log_composite + LEAST_GAIN:
            break
        poses, log_composite = other, log_other
    return poses


def _seek_contradicting(registrar: KeyframeRegistrar, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each keyframe that contradicts the map of all others sought in it, the worst first.

    A place is taken with which all images agree more.
    """
    ratios = [
        inlier_ratio(registrar.register_locally(poses, index, registrar.all_but(index)))
        for index in range(len(registrar))
    ]
    log_composite = registrar.log_composite(poses)
    for index in np.argsort(ratios).tolist():
        if not index or ratios[index] >= CONSISTENT_INLIER_RATIO:
            continue
        for place in registrar.register_globally(poses, index, registrar.all_but(index))[:PLACES]:
            other = _align_in_turn(registrar, _move(poses, index, place))
            if (log_other := registrar.log_composite(other)) > log_composite:
                poses, log_composite = other, log_other
    return poses


def _align_in_turn(registrar: KeyframeRegistrar, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each keyframe in turn at the optimum next to it in the map of all the others, a few times."""
    for index in list(range(1, len(registrar))) * SETTLING_SWEEPS:
        poses = _move(poses, index, registrar.register_locally(poses, index, registrar.all_but(index)))
    return poses


def _move(poses: NDArray[np.float64], index: int, place: Registration) -> NDArray[np.float64]:
    """Poses (N, 4, 4) with one moved, unless that left the numbers."""
    if not place.is_finite:
        return poses
    poses = poses.copy()
    poses[index] = matrices_of(place.optimum.pose)
    return poses


def _take_distinct(maps: Iterable[NDArray[np.float64]], count: int) -> list[NDArray[np.float64]]:
    """The first `count` maps (N, 4, 4) in which some keyframe stands elsewhere than in those before."""
    kept: list[NDArray[np.float64]] = []
    for poses in maps:
        if not any(_are_alike(poses, other) for other in kept):
            kept.append(poses)
        if len(kept) == count:
            break
    return kept


def _are_alike(poses: NDArray[np.float64], others: NDArray[np.float64]) -> bool:
    """Whether all keyframes of two maps (N, 4, 4) stand in the same places."""
    return bool((np.linalg.norm(poses[:, :3, 3] - others[:, :3, 3], axis=1) < SAME_SHIFT_M).all())
