"""Best-first search over partial maps: keyframes are placed in order of evidence, not of time.

Views a third of a circle apart share little; views of two rings, one above the other, share much but are far
apart in the recording; round an object that looks alike from many sides a pair of views fits in many ways.
So every pair of keyframes is registered first, and the places found are put together: partial maps begin with
the pairs of most evidence, whichever they are, and are extended by any keyframe where its place beside any
one of theirs puts it. The maps kept are those of most evidence, sum of log p(image | map, pose) -
log p(image | no map), which compares maps of different keyframes; a few of every size (a beam). Of whole maps
those are kept that the prior of motion, too, says are likely.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from recordings.types import DepthNoise
from shapes.geometry.poses import matrices_of
from slam.likelihood.image_density import log_image_density
from slam.map_hypotheses.cross_registration import KeyframeRegistrar
from slam.registration.registered import SAME_SHIFT_M, Registration

KEPT_MAPS, TRIED_MAPS = 8, 64
"""Partial maps of every size, and extensions of them that are brought to their optimum. Search effort."""

COMPLETE_MAPS = 3
"""That are settled: search effort."""

PLACES = 3
"""Of each keyframe in the map of all others."""

BLUR = 0.03
"""Relative to depth, of the surfaces by which extensions are ranked: they are put together of two ways."""

SETTLING_SWEEPS = 3
"""Search effort."""


@dataclass(frozen=True)
class PartialMap:
    """Some of the keyframes.

    Attributes:
        poses: (4, 4) by keyframe, the last one placed last.
        log_evidence: for their places.
    """

    poses: dict[int, NDArray[np.float64]]
    log_evidence: float

    @property
    def keyframes(self) -> tuple[int, ...]:
        """In order."""
        return tuple(sorted(self.poses))

    @property
    def from_first(self) -> NDArray[np.float64]:
        """Poses (m, 4, 4) of the keyframes in order, in the first one's frame."""
        poses = np.stack([self.poses[index] for index in self.keyframes])
        return np.linalg.inv(poses[0]) @ poses

    def is_like(self, other: PartialMap) -> bool:
        """Whether it has the same keyframes in the same places."""
        if self.keyframes != other.keyframes:
            return False
        apart = self.from_first[:, :3, 3] - other.from_first[:, :3, 3]
        return bool((np.linalg.norm(apart, axis=1) < SAME_SHIFT_M).all())


Ways = dict[tuple[int, int], list[NDArray[np.float64]]]
"""By two keyframes: poses first_from_second (4, 4) where the one may stand beside the other."""


def place_best_first(
    registrar: KeyframeRegistrar, log_weight: Callable[[float, NDArray[np.float64]], float]
) -> list[NDArray[np.float64]]:
    """Poses (N, 4, 4) of all keyframes from the first: maps that differ, none where one has no place.

    They are settled, and the one that all images agree with most is improved keyframe by keyframe.

    Args:
        registrar: the keyframes.
        log_weight: of a whole map, given its log evidence and its poses.
    """
    ways, maps = _pairs(registrar)
    unknown = np.asarray([registrar.log_score_of_unknown(index, BLUR) for index in range(len(registrar))])
    for _ in range(len(registrar) - 2):
        maps = _extended(registrar, _surest(maps), ways, unknown)
    weights = [log_weight(each.log_evidence, each.from_first) for each in maps]
    settled = [_settled(registrar, each.from_first) for each in _distinct(maps, weights, COMPLETE_MAPS)]
    if not settled:
        return []
    settled.sort(key=registrar.log_composite, reverse=True)
    return [_improved_singly(registrar, settled[0]), *settled[1:]]


def _pairs(registrar: KeyframeRegistrar) -> tuple[Ways, list[PartialMap]]:
    """The ways between all pairs of keyframes, and the pairs."""
    ways: Ways = {}
    maps: list[PartialMap] = []
    alone = np.tile(np.eye(4), (len(registrar), 1, 1))
    for second in range(len(registrar)):
        for first in range(second):
            places = registrar.register_globally(alone, second, [first])
            found = [matrices_of(place.optimum.pose).astype(np.float64) for place in places]
            ways[first, second] = found
            ways[second, first] = [np.linalg.inv(way).astype(np.float64) for way in found]
            maps += [
                PartialMap({first: np.eye(4), second: way}, _log_evidence(place, registrar.noise))
                for way, place in zip(found, places, strict=True)
            ]
    return ways, maps


def _extended(
    registrar: KeyframeRegistrar, maps: list[PartialMap], ways: Ways, unknown: NDArray[np.float64]
) -> list[PartialMap]:
    """The maps with one keyframe more, at its optimum: those of `TRIED_MAPS` extensions that fit best."""
    begun = [one for each in maps for one in _begun(each, ways, len(registrar))]
    extended = []
    for each in _distinct(begun, _fits(registrar, begun, unknown), TRIED_MAPS):
        *others, new = each.poses
        poses = np.stack([each.poses.get(index, np.eye(4)) for index in range(len(registrar))])
        place = registrar.register_locally(poses, new, sorted(others))
        if place.is_finite and place.is_plausible:
            placed = {**each.poses, new: matrices_of(place.optimum.pose)}
            extended.append(PartialMap(placed, each.log_evidence + _log_evidence(place, registrar.noise)))
    return extended


def _begun(partial: PartialMap, ways: Ways, count: int) -> Iterator[PartialMap]:
    """A map with one of the `count` keyframes more, beside any of its own; the evidence is as before."""
    for new in range(count):
        if new not in partial.poses:
            for beside, pose in partial.poses.items():
                for way in ways[beside, new]:
                    yield replace(partial, poses={**partial.poses, new: pose @ way})


def _fits(
    registrar: KeyframeRegistrar, maps: list[PartialMap], unknown: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Approximate evidence (C,) for partial maps, where images beside no keyframe have `unknown` (N,)."""
    fits = np.zeros(len(maps))
    for keyframes in {each.keyframes for each in maps}:
        alike = [index for index, each in enumerate(maps) if each.keyframes == keyframes]
        poses = np.stack([maps[index].from_first for index in alike])
        fits[alike] = registrar.log_scores(keyframes, poses, keyframes, BLUR)
        fits[alike] -= unknown[list(keyframes)].sum()
    return fits


def _settled(registrar: KeyframeRegistrar, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each keyframe in turn at the optimum next to it in the map of all the others, a few times.

    In partial maps they were placed by few, millimetres off, which costs as much as modes differ by.
    """
    for index in list(range(1, len(registrar))) * SETTLING_SWEEPS:
        poses = _with(poses, index, registrar.register_locally(poses, index, registrar.all_but(index)))
    return poses


def _improved_singly(registrar: KeyframeRegistrar, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Each keyframe in turn sought in the map of all the others; a map that all agree with more is taken.

    What was placed first was placed by least.
    """
    log_composite = registrar.log_composite(poses)
    for index in range(1, len(registrar)):
        for place in registrar.register_globally(poses, index, registrar.all_but(index))[:PLACES]:
            other = _settled(registrar, _with(poses, index, place))
            if (log_other := registrar.log_composite(other)) > log_composite:
                poses, log_composite = other, log_other
    return poses


def _with(poses: NDArray[np.float64], index: int, place: Registration) -> NDArray[np.float64]:
    """Poses (N, 4, 4) with one moved, unless that left the numbers."""
    if not place.is_finite:
        return poses
    poses = poses.copy()
    poses[index] = matrices_of(place.optimum.pose)
    return poses


def _log_evidence(place: Registration, noise: DepthNoise) -> float:
    """Log p(image | map, place) - log p(image | no map)."""
    pixels, poses = place.optimum.pixels, place.local_map.keyframes_from_camera(place.optimum.pose)
    without_map = replace(pixels, weights=jnp.zeros_like(pixels.weights))
    return float(place.optimum.log_density - log_image_density(without_map, poses, noise, 1.0))


def _distinct(maps: Sequence[PartialMap], scores: ArrayLike, count: int) -> list[PartialMap]:
    """The `count` of the highest scores (C,) that differ."""
    kept: list[PartialMap] = []
    for index in np.argsort(-np.asarray(scores, np.float64), kind="stable").tolist():
        if not any(maps[index].is_like(other) for other in kept):
            kept.append(maps[index])
        if len(kept) == count:
            break
    return kept


def _surest(maps: Sequence[PartialMap]) -> list[PartialMap]:
    """The `KEPT_MAPS` of most evidence that differ."""
    return _distinct(maps, [each.log_evidence for each in maps], KEPT_MAPS)
