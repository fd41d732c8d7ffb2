"""The optimum of the overlap graph also where the filter drifted: from wide gates to narrow ones.

Along a path errors add up, so that a keyframe may be decimetres off that is a centimetre off its neighbours.
Gates as wide as neighbours are apart draw the whole graph together; which ones overlap is then asked anew.
Where the camera comes back to a place with a drift wider than that, the loop is closed first.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.likelihood.distortion import NODES
from slam.pose_graph.gauss_newton import (
    HELD_DAMPING,
    HELD_INFLATIONS,
    INFLATIONS,
    GraphOptimum,
    agreement,
    optimise,
)
from slam.pose_graph.loops import closed, find_loops
from slam.pose_graph.overlaps import KeyframeImages, Keyframes
from slam.pose_graph.trajectory_prior import TrajectoryPrior

COARSE_INFLATIONS = (32.0, 32.0, 16.0, 16.0, 8.0, 8.0, *INFLATIONS)
"""Of sigma in the first rounds: gates of 0.2 m to 1 cm at 2 m, where sigma is 6 mm."""

NO_INFLATIONS = (1.0,)
"""For steps that lead uphill alone: the density is that of sigma itself."""

COARSE_FARTHEST = 1.0
"""Metres or radians. Drift of 3 cm a keyframe over twenty of them is 0.6 m."""

COARSE_ROUNDS = 2
"""Overlaps are asked anew once."""


def optimise_coarse_to_fine(
    images: KeyframeImages, poses: NDArray[np.float32], motion: TrajectoryPrior | None = None
) -> tuple[Keyframes, GraphOptimum | None]:
    """The optimum near poses (N, 7), or beyond where a keyframe is far from it, and the overlaps there.

    With `motion` keyframes are few, and have been placed by search.
    """
    keyframes = images.at(poses)
    if motion is not None:
        return keyframes, optimise(keyframes, poses, HELD_INFLATIONS, motion=motion)
    near = optimise(keyframes, poses)
    is_far = near is None or near.astray.any()
    start = poses if near is None or is_far else near.poses
    if is_far:
        climbed = optimise(keyframes, poses, NO_INFLATIONS, COARSE_FARTHEST, uphill=True)
        near = climbed if near is None else _better(keyframes, climbed, near, poses)
    chain = agreement(keyframes, start)
    if chain is not None and (loops := find_loops(images, chain, start)):
        return _drawn_together(images, closed(chain, start, loops), poses, keyframes, near)
    if is_far:
        return _drawn_together(images, start, poses, keyframes, near)
    return keyframes, near


def _drawn_together(
    images: KeyframeImages,
    start: NDArray[np.float32],
    filtered: NDArray[np.float32],
    keyframes: Keyframes,
    near: GraphOptimum | None,
) -> tuple[Keyframes, GraphOptimum | None]:
    """The optimum within wide gates of a start (N, 7), or the one that is known where that one is better.

    Without one that is known it is to be better than where the filter has the keyframes (N, 7).
    """
    there, far = images.at(start), None
    for _ in range(COARSE_ROUNDS):
        found = optimise(there, start, COARSE_INFLATIONS, COARSE_FARTHEST, damping=HELD_DAMPING)
        if found is None or not np.isfinite(found.poses).all():
            return keyframes, near
        far, start = found, found.poses
        there = images.at(start)
    best = _better(there, far, near, filtered)
    return (there, far) if best is far else (keyframes, near)


def _better(
    keyframes: Keyframes,
    one: GraphOptimum | None,
    other: GraphOptimum | None,
    filtered: NDArray[np.float32],
) -> GraphOptimum | None:
    """The first of two optima unless overlaps are denser at the other or, without it, as filtered."""
    if one is None:
        return other
    none = np.zeros((2, NODES))
    known = filtered if other is None else other.poses
    log_densities = keyframes.log_densities(np.stack([one.poses, known]), none, one.exponents)
    return one if log_densities[0] >= log_densities[1] else other
