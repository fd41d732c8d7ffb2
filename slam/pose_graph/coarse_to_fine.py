"""The optimum of the overlap graph also where the filter drifted: from wide gates to narrow ones.

Along a path errors add up, so that a keyframe may be decimetres off that is a centimetre off its neighbours.
Gates as wide as neighbours are apart draw the whole graph together; which ones overlap is then asked anew.
Where the camera comes back to a place with a drift wider than that, the loop is closed first.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from slam.pose_graph.gauss_newton import (
    HELD_DAMPING,
    HELD_INFLATIONS,
    INFLATIONS,
    GraphOptimum,
    agreement,
    optimise,
)
from slam.pose_graph.loops import NO_LOOPS, Loops, closed, find_loops
from slam.pose_graph.overlaps import KeyframeImages, Keyframes
from slam.pose_graph.trajectory_prior import TrajectoryPrior

COARSE_INFLATIONS = (32.0, 32.0, 16.0, 16.0, 8.0, 8.0, *INFLATIONS)
"""Of sigma in the first rounds: gates of 0.2 m to 1 cm at 2 m, where sigma is 6 mm."""

COARSE_FARTHEST = 1.0
"""Metres or radians. Drift of 3 cm a keyframe over twenty of them is 0.6 m."""

COARSE_ROUNDS = 2
"""Overlaps are asked anew once."""


def optimise_coarse_to_fine(
    images: KeyframeImages,
    poses: NDArray[np.float32],
    motion: TrajectoryPrior | None = None,
    fixed: int = 1,
    on_phase: Callable[[str], None] = lambda _: None,
) -> tuple[Keyframes, GraphOptimum | None, Loops]:
    """The optimum near poses (N, 7), or beyond where a keyframe is far from it, and the overlaps there.

    So many keyframes, the first ones, are fixed. A loop that is closed concerns all: the graph of relative
    poses takes the fixed ones along, and only the others are brought to the optimum there.
    With `motion` keyframes are few, and have been placed by search. Gauss-Newton steps may slide off along
    what little is seen: where no optimum that they find is denser than the start, it is climbed from there.
    `on_phase` is told of loops that are closed, for with thousands of keyframes that takes minutes.
    """
    keyframes = images.at(poses, fixed)
    if motion is not None:
        return keyframes, optimise(keyframes, poses, HELD_INFLATIONS, motion=motion, uphill=True), NO_LOOPS
    near = optimise(keyframes, poses)
    is_far = near is None or bool(near.astray.any())
    start = poses if near is None or is_far else near.poses
    chain = agreement(keyframes, start)
    loops = NO_LOOPS if chain is None else find_loops(images, chain, start)
    if chain is not None and loops.are_open(start):
        on_phase(f"closing a loop over {len(poses)} keyframes")
        if fixed > 1:
            chain = agreement(images.at(start), start)
        start, loops = (start, NO_LOOPS) if chain is None else closed(chain, start, loops)
        images = images.with_known(loops.pairs)
    elif not is_far:
        return keyframes, near, loops
    there, far = _drawn_together(images, start, fixed)
    if far is not None and _is_better(there, far, poses if near is None else near.poses):
        return there, far, loops
    if not is_far:
        return keyframes, near, loops
    climbed = optimise(keyframes, poses, HELD_INFLATIONS, COARSE_FARTHEST, uphill=True)
    is_best = climbed is not None and (near is None or _is_better(keyframes, climbed, near.poses))
    return keyframes, climbed if is_best else near, loops


def _drawn_together(
    images: KeyframeImages, start: NDArray[np.float32], fixed: int
) -> tuple[Keyframes, GraphOptimum | None]:
    """The optimum within wide gates of a start (N, 7), and the overlaps there."""
    there, far = images.at(start, fixed), None
    for _ in range(COARSE_ROUNDS):
        far = optimise(there, start, COARSE_INFLATIONS, COARSE_FARTHEST, damping=HELD_DAMPING)
        if far is None or not np.isfinite(far.poses).all():
            return there, None
        start = far.poses
        there = images.at(start, fixed)
    return there, far


def _is_better(keyframes: Keyframes, one: GraphOptimum, other: NDArray[np.float32]) -> bool:
    """Whether the density of overlaps is greater at an optimum than at other poses (N, 7)."""
    log_densities = keyframes.log_densities(np.stack([one.poses, other]), one.exponents)
    return bool(log_densities[0] > log_densities[1])
