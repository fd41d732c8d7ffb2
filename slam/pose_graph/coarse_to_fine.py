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
    inflations = INFLATIONS if motion is None else HELD_INFLATIONS
    near = optimise(keyframes, poses, inflations, motion=motion)
    if motion is not None:
        return keyframes, near
    start = poses if near is None or near.astray.any() else near.poses
    chain = agreement(keyframes, start)
    if chain is not None and (loops := find_loops(images, chain, start)):
        return _drawn_together(images, closed(chain, start, loops), keyframes, near)
    if near is None or near.astray.any():
        return _drawn_together(images, start, keyframes, near)
    return keyframes, near


def _drawn_together(
    images: KeyframeImages, start: NDArray[np.float32], keyframes: Keyframes, near: GraphOptimum | None
) -> tuple[Keyframes, GraphOptimum | None]:
    """The optimum within wide gates of a start (N, 7), or the one that is known where that one is better."""
    there, far = images.at(start), None
    for _ in range(COARSE_ROUNDS):
        found = optimise(there, start, COARSE_INFLATIONS, COARSE_FARTHEST, damping=HELD_DAMPING)
        if found is None or not np.isfinite(found.poses).all():
            return keyframes, near
        far, start = found, found.poses
        there = images.at(start)
    if near is None or far is None or _is_better(there, far, near):
        return there, far
    return keyframes, near


def _is_better(keyframes: Keyframes, one: GraphOptimum, other: GraphOptimum) -> bool:
    """Whether the density of overlaps is greater at one optimum than at another."""
    none = np.zeros((2, NODES))
    log_densities = keyframes.log_densities(np.stack([one.poses, other.poses]), none, one.exponents)
    return bool(log_densities[0] > log_densities[1])
