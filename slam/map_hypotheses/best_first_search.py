"""Best-first search over partial maps: keyframes are placed in order of evidence, not of time.

Views a third of a circle apart share little; views of two rings, one above the other, share much but are far
apart in the recording. The search extends partial maps, from the first keyframe alone, by any keyframe at any
pose where it registers, and keeps the maps of highest evidence sum of log p(image | map, pose) -
log p(image | no map), which compares maps of different keyframes. A few are kept at every size (a beam). Only
the keyframes with the highest evidence in the smaller map are registered again in the larger one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from shapes.geometry.pose_sets import GROUP_SHIFT_M
from shapes.geometry.poses import matrices_of
from slam.likelihood.image_density import log_image_density
from slam.map_hypotheses.cross_registration import KeyframeRegistrar
from slam.registration.registered import Registration

KEPT_MAPS, SOUGHT = 3, 2
"""Partial maps, and keyframes that are sought again in each."""

PLACES = 3
"""Of each keyframe in each map."""

SETTLING_SWEEPS = 3
"""Search effort."""


@dataclass(frozen=True)
class _PartialMap:
    """Some of the keyframes.

    Attributes:
        poses: (4, 4) by keyframe.
        log_evidence: for their places.
        foretold: by other keyframe that was sought before, the evidence that its best place had then.
    """

    poses: dict[int, NDArray[np.float64]]
    log_evidence: float
    foretold: dict[int, float]

    def is_like(self, other: _PartialMap) -> bool:
        """Whether it has the same keyframes in the same places."""
        return self.poses.keys() == other.poses.keys() and all(
            np.linalg.norm(pose[:3, 3] - other.poses[index][:3, 3]) < GROUP_SHIFT_M
            for index, pose in self.poses.items()
        )


def place_best_first(registrar: KeyframeRegistrar) -> NDArray[np.float64] | None:
    """Poses (N, 4, 4) of all keyframes, or None where one is found in no map.

    Of the maps kept it is the one that all images agree with most, improved keyframe by keyframe.
    """
    maps = [_PartialMap({0: np.eye(4)}, 0.0, {})]
    for _ in range(len(registrar) - 1):
        maps = _best([extended for each in maps for extended in _extended(registrar, each)])
    complete = [np.stack([each.poses[index] for index in range(len(registrar))]) for each in maps]
    settled = [_settled(registrar, poses) for poses in complete]
    return _improved_singly(registrar, max(settled, key=registrar.log_composite)) if settled else None


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


def _extended(registrar: KeyframeRegistrar, partial: _PartialMap) -> list[_PartialMap]:
    """The maps with one keyframe more."""
    core = sorted(partial.poses)
    poses = np.stack([partial.poses.get(index, np.eye(4)) for index in range(len(registrar))])
    new = [index for index in range(len(registrar)) if index not in partial.poses | partial.foretold]
    surest = sorted(partial.foretold, key=lambda index: -partial.foretold[index])[:SOUGHT]
    places = {index: registrar.register_globally(poses, index, core)[:PLACES] for index in new or surest}
    evidence = {
        index: [_log_evidence(place, registrar.noise) for place in found] for index, found in places.items()
    }
    foretold = partial.foretold | {index: max(found, default=-np.inf) for index, found in evidence.items()}
    return [
        _PartialMap(
            {**partial.poses, index: matrices_of(place.optimum.pose)},
            partial.log_evidence + log_evidence,
            {other: before for other, before in foretold.items() if other != index},
        )
        for index, found in places.items()
        for place, log_evidence in zip(found, evidence[index], strict=True)
    ]


def _log_evidence(place: Registration, noise: DepthNoise) -> float:
    """Log p(image | map, place) - log p(image | no map)."""
    pixels, poses = place.optimum.pixels, place.local_map.keyframes_from_camera(place.optimum.pose)
    without_map = replace(pixels, weights=jnp.zeros_like(pixels.weights))
    return float(place.optimum.log_density - log_image_density(without_map, poses, noise, 1.0))


def _best(maps: list[_PartialMap]) -> list[_PartialMap]:
    """The `KEPT_MAPS` of most evidence that differ."""
    kept: list[_PartialMap] = []
    for each in sorted(maps, key=lambda one: -one.log_evidence):
        if not any(each.is_like(other) for other in kept):
            kept.append(each)
        if len(kept) == KEPT_MAPS:
            break
    return kept
