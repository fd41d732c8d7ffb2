"""Whole maps of keyframes brought to the optimum next to them, all keyframes at once.

What a search leaves is centimetres off. Along bare walls each view is held by others that are off as well:
one by one, each in the map of the others, they need dozens of rounds, the graph of their overlaps
(`slam.keyframe_optimum`) needs few.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from shapes.poses import matrices_of
from slam.keyframe_map import KeyframeMap
from slam.keyframe_motion import KeyframeMotion
from slam.keyframe_optimum import HELD_INFLATIONS, INFLATIONS, optimum
from slam.keyframe_overlaps import Detail, keyframes_at
from slam.rigid import single_precision_poses

FAR_INFLATIONS = (16.0, 8.0, *INFLATIONS)
"""Of sigma in the first rounds."""
FARTHEST = 0.3
"""Metres or radians that a keyframe may move."""


def settled(
    poses: NDArray[np.float64],
    keyframe_map: KeyframeMap,
    details: Sequence[Detail],
    noise: DepthNoise,
    motion: KeyframeMotion,
) -> NDArray[np.float64]:
    """The map (N, 4, 4) at the optimum near `poses`; as it is where no keyframes overlap.

    The motion prior comes last: an orbit's distances, good to millimetres, would bend what is far off.

    Args:
        poses: reference_from_keyframe.
        keyframe_map: at working resolution.
        details: of the keyframes.
        noise: the sensor at that detail.
        motion: prior of the keyframes' poses.
    """
    keyframes = keyframes_at(keyframe_map, details, poses, noise)
    for inflations, prior in ((FAR_INFLATIONS, None), (HELD_INFLATIONS, motion)):
        found = optimum(keyframes, np.asarray(single_precision_poses(poses)), inflations, FARTHEST, prior)
        if found is None or not np.isfinite(found[0]).all():
            return poses
        moved = matrices_of(found[0])
        poses = np.linalg.inv(moved[0]) @ moved
    return poses
