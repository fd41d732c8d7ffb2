"""Candidate maps of few keyframes, proposed independently of the filter, jointly optimised and weighed.

Views far apart are explained by more than one map: a corner of a bare room by any other, an object on a
pedestal from the wrong side. Several maps are proposed, brought to the nearest optimum of the overlap graph
(`slam.pose_graph.gauss_newton`), and weighed by the composite likelihood of all images, calibrated by its
own variance (`slam.map_hypotheses.map_odds`), times the trajectory prior. Those of non-negligible weight are
kept, and the starts of the search tell how much it may have missed (`slam.map_hypotheses.modes`).

The joint optimum is needed since searched poses are centimetres off. Keyframe by keyframe, each against the
map of the others, a bare wall takes dozens of rounds; the graph takes few.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from shapes.geometry.poses import matrices_of, single_precision_poses
from slam.filter.motion import OrbitMotion
from slam.keyframes.depth_view import central_depth
from slam.map_hypotheses.circular_paths import circular_steps, repeat_step
from slam.map_hypotheses.cross_registration import (
    KeyframeRegistrar,
    consistent_set,
    register_inconsistent,
)
from slam.map_hypotheses.map_odds import log_odds
from slam.map_hypotheses.modes import Modes
from slam.map_hypotheses.spanning_trees import place_by_spanning_trees
from slam.pose_graph.gauss_newton import HELD_INFLATIONS, INFLATIONS, optimise
from slam.pose_graph.overlaps import KeyframeImages
from slam.pose_graph.trajectory_prior import TrajectoryPrior

REGULAR_DISTANCES = (0.3, 0.4, 0.5, 0.65, 0.8, 1.0, 1.25)
"""To the pivot of a circle, in depths at the image centre: the object there, or halfway to a far wall."""

MOST_ROUNDS = 3
"""After the first, in which keyframes are placed without regard to any map."""

REGULAR_MAPS = 6
"""Circles that are jointly optimised: in a bare room three by quarter turns, a corner each view, came before
the right one (a circle of 5; docs/model.md, development films)."""


def candidate_maps(
    registrar: KeyframeRegistrar,
    present: Sequence[NDArray[np.float64]],
    motion: TrajectoryPrior,
    images: KeyframeImages,
    rng: np.random.Generator,
) -> Modes:
    """Maps of all keyframes and their probabilities.

    Args:
        registrar: the keyframes.
        present: maps (N, 4, 4) of the filter.
        motion: prior of the keyframes' poses.
        images: of the keyframes.
        rng: of the search; used.
    """
    settle = partial(optimise_jointly, images=images, motion=motion)
    maps = [settle(poses) for poses in (*present, *_regular_maps(registrar, motion))]
    blocks = [registrar.log_composite_of_blocks(poses) for poses in maps]
    searched: range | None = None

    def log_weights() -> NDArray[np.float64]:
        return log_odds(np.stack(blocks)) + [motion.log_density(poses) for poses in maps]

    for round_ in range(1 + MOST_ROUNDS):
        best = maps[int(np.argmax(log_weights()))]
        core = consistent_set(registrar, best)
        if len(core) == len(registrar):
            break
        if round_:
            proposed = [register_inconsistent(registrar, best, core)]
        else:
            proposed = place_by_spanning_trees(registrar, settle, motion.log_density, rng)
            searched = range(len(maps), len(maps) + len(proposed))
        settled = [settle(poses) for poses in proposed]
        maps += settled
        blocks += [registrar.log_composite_of_blocks(poses) for poses in settled]
    return Modes.of(maps, log_weights().tolist(), searched)


def _regular_maps(registrar: KeyframeRegistrar, motion: TrajectoryPrior) -> list[NDArray[np.float64]]:
    """Maps (N, 4, 4) on circles of the orbit's radius, where there is one, or of any."""
    distances = np.asarray(REGULAR_DISTANCES, np.float64) * central_depth(registrar.view(0))
    if isinstance(motion.motion, OrbitMotion):
        distances = np.asarray([np.linalg.norm(motion.pivot_m)], np.float64)
    return [repeat_step(step, len(registrar)) for step in circular_steps(registrar, distances)[:REGULAR_MAPS]]


FAR_INFLATIONS = (16.0, 8.0, *INFLATIONS)
"""Of sigma in the first rounds."""

FARTHEST = 0.3
"""Metres or radians that a keyframe may move."""


def optimise_jointly(
    poses: NDArray[np.float64], images: KeyframeImages, motion: TrajectoryPrior
) -> NDArray[np.float64]:
    """The map at the optimum near `poses` (N, 4, 4); as it is where no keyframes overlap.

    The motion prior comes last: an orbit's distances, good to millimetres, would bend what is far off.
    """
    keyframes = images.placed(poses)
    for inflations, prior in ((FAR_INFLATIONS, None), (HELD_INFLATIONS, motion)):
        start = np.asarray(single_precision_poses(poses))
        found = optimise(keyframes, start, inflations, FARTHEST, prior, uphill=True)
        if found is None or not np.isfinite(found.poses).all():
            return poses
        moved = matrices_of(found.poses)
        poses = np.linalg.inv(moved[0]) @ moved
    return poses
