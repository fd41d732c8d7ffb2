"""Other turns of an object about the line about which most of it is round, that look better.

A mug whose handle was thought to be hidden may well show it: a narrow mode, which a search on a coarse grid
of turns misses while the body looks right.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

MOST = 2
"""Turns of an object that are looked at."""
APART = 2 * np.pi / 36
"""Radians between them, and between them and none."""


def spun(poses: NDArray[np.float64], lines: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Poses (N, count, 7) once round the lines (N, 2, 3) of their box frames, from poses (N, 7) on."""
    angles = 2 * np.pi * np.arange(count) / count
    spins = [Rotation.from_rotvec(angles[:, None] * line[0]) for line in lines]
    placed = [Rotation.from_quat(pose[[1, 2, 3, 0]]) for pose in poses]
    turned = [before * spin for before, spin in zip(placed, spins, strict=True)]
    return np.stack(
        [
            np.concatenate(
                [
                    after.as_quat()[:, [3, 0, 1, 2]],
                    pose[4:] + before.apply(line[1]) - after.apply(line[1]),
                ],
                axis=1,
            )
            for pose, line, before, after in zip(poses, lines, placed, turned, strict=True)
        ]
    )


def better(log_densities: NDArray[np.floating]) -> list[int]:
    """Places of the highest peaks of S equal steps round a circle that are higher than the first step's."""
    count = len(log_densities)
    least = APART * count / (2 * np.pi)
    highest = (log_densities >= np.roll(log_densities, 1)) & (log_densities >= np.roll(log_densities, -1))
    chosen = [0]
    for place in np.argsort(-np.where(highest, log_densities, -np.inf)).tolist():
        if not highest[place] or log_densities[place] <= log_densities[0] or len(chosen) > MOST:
            break
        steps = np.abs(place - np.array(chosen))
        if np.minimum(steps, count - steps).min() >= least:
            chosen.append(place)
    return chosen[1:]
