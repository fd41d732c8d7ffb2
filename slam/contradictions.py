"""Keyframes that contradict the others: which they are, and where else they may stand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shapes.poses import matrices_of
from slam.jury import Jury, agreement

AGREEING = 0.9
"""Share of the returns that meet the map and lie on it, from which on a keyframe does not contradict: at true
poses round objects it was .92 at least, at wrong ones .6 to .9 (development films, seeds 0 and 101)."""
LEAST_CORE = 2


def placed_anew(jury: Jury, poses: NDArray[np.float64], core: list[int]) -> NDArray[np.float64]:
    """Poses (N, 4, 4) with those that are not of the `core` sought in its map."""
    poses = poses.copy()
    missing = [index for index in range(len(jury)) if index not in core]
    while missing:
        found = {index: next(iter(jury.sought(poses, index, core)), None) for index in missing}
        sure = [index for index in missing if (place := found[index]) and agreement(place) >= AGREEING]
        most = max(missing, key=lambda index: place.explained if (place := found[index]) else -1.0)
        for index in sure or [most]:
            if place := found[index]:
                poses[index] = matrices_of(place.optimum.pose)
            core, missing = sorted([*core, index]), [other for other in missing if other != index]
    return np.linalg.inv(poses[0]) @ poses


def agreeing(jury: Jury, poses: NDArray[np.float64]) -> list[int]:
    """Keyframes that do not contradict each other: those that do most are left out, one by one."""
    core = list(range(len(jury)))
    while len(core) > LEAST_CORE:
        agreements = [
            agreement(jury.located(poses, index, [other for other in core if other != index]))
            for index in core
        ]
        worst = int(np.argmin(agreements))
        if agreements[worst] >= AGREEING:
            break
        del core[worst]
    return core
