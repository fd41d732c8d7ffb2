"""Sets of poses: distance tests, clusters, suppression of duplicates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""wxyz_xyz."""


GROUP_SHIFT_M = 0.1
"""Poses closer than this are one place. Chosen by hand."""

GROUP_ANGLE_RAD = 0.1
"""As `GROUP_SHIFT_M`."""

MAX_CLUSTERS = 4
"""Search effort: maps that are refined, paths that are told."""

LEAST_GROUP_WEIGHT = 1e-3
"""Less than one draw of 64."""


def within_reach(
    one: NDArray[np.float64],
    other: NDArray[np.float64],
    shift_m: float = GROUP_SHIFT_M,
    angle_rad: float = GROUP_ANGLE_RAD,
) -> NDArray[np.bool_]:
    """Whether (...) poses (..., 4, 4) stand within a shift and a turn of each other."""
    relative = np.linalg.inv(one) @ other
    cosine = 0.5 * (np.trace(relative[..., :3, :3], axis1=-2, axis2=-1) - 1)
    return (np.linalg.norm(relative[..., :3, 3], axis=-1) < shift_m) & (cosine > np.cos(angle_rad))


def cluster(poses: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.int_]:
    """Group (K,) of each draw by its pose (K, 4, 4), or by all of its poses (K, N, 4, 4).

    Group 0 holds the heaviest. Draws join the first leader within reach, leaders being the heaviest. Groups
    of negligible weight, and all beyond `MAX_CLUSTERS`, join group 0.
    """
    groups = np.full(len(poses), -1)
    count = 0
    for leader in np.argsort(-weights, kind="stable"):
        if groups[leader] >= 0:
            continue
        near = within_reach(poses[leader], poses)
        members = near.reshape(len(poses), -1).all(axis=1) & (groups < 0)
        members[leader] = True
        negligible = weights[members].sum() < LEAST_GROUP_WEIGHT or count == MAX_CLUSTERS
        groups[members] = 0 if count and negligible else count
        count += not (count and negligible)
    return groups


def suppress_similar(
    poses: NDArray[np.float64], count: int, shift_m: float, angle_rad: float
) -> NDArray[np.int_]:
    """Indices of the first `count` poses (C, 4, 4) that differ from each other, in their given order."""
    chosen: list[int] = []
    for index, pose in enumerate(poses):
        if not within_reach(poses[chosen], pose, shift_m, angle_rad).any():
            chosen.append(index)
        if len(chosen) == count:
            break
    return np.asarray(chosen, int)


def pad_to_multiple(poses: NDArray[np.float64], multiple: int) -> NDArray[np.float64]:
    """Poses (C, ..., 4, 4) with the first repeated up to a multiple, so that kernels are compiled once."""
    return np.concatenate([poses, np.repeat(poses[:1], -len(poses) % multiple, axis=0)])
