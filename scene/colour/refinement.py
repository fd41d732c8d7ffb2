"""Poses of many things refined at once, each in the same surroundings, by halving steps; curvature at the end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.colour.lattice import Surroundings, placed_gains
from scene.colour.posterior import ColourImage
from scene.colour.world import TableWorld

FIRST_STEP = np.array([0.010, 0.010, 0.26])
"""Half a lattice cell: metres, metres, radians."""
HALVINGS = 5
"""The last step is 0.6 mm and one degree: below it pixels no longer tell poses apart."""
CURVED_STEP = 4
"""Halvings after which curvature is read: over 1.2 mm and two degrees, wide enough to average over pixels."""


@dataclass(frozen=True, eq=False)
class Refined:
    """Poses at which gains are greatest nearby.

    Attributes:
        poses: (B, 3).
        gains: (B,) log.
        sd: (B, 3) of a Gaussian with the curvature there, axes apart; of the prior at most.
    """

    poses: NDArray[np.float64]
    gains: NDArray[np.float64]
    sd: NDArray[np.float64]


def refine(
    world: TableWorld,
    image: ColourImage,
    rest: Surroundings,
    kinds: NDArray[np.int64],
    poses: NDArray[np.float64],
) -> Refined:
    """Climb from `poses` (B, 3): the six neighbours, and where parabolas through them have their tops."""
    poses, count = poses.copy(), len(poses)
    spins = np.array([world.kinds[kind].turns != 0 for kind in kinds], np.bool_)
    best = placed_gains(world, image, rest, kinds, poses)
    sd = np.tile([world.half_m, world.half_m, np.pi], (count, 1))
    offsets = np.concatenate([np.eye(3), -np.eye(3)])
    for halving in range(HALVINGS):
        step = FIRST_STEP * 0.5**halving
        around = poses[:, None] + offsets * step
        value = placed_gains(world, image, rest, np.repeat(kinds, 6), around.reshape(-1, 3)).reshape(-1, 6)
        curvature = np.minimum(value[:, :3] + value[:, 3:] - 2 * best[:, None], 0.0) / step**2
        if halving <= CURVED_STEP:
            sd = _deviations(curvature, world, spins)
        slope = np.where(np.isfinite(value).all(axis=1)[:, None], value[:, :3] - value[:, 3:], 0.0)
        with np.errstate(invalid="ignore"):
            top = np.clip(slope / (2 * step) / np.maximum(-curvature, 1e-9), -1.5 * step, 1.5 * step)
        joint = poses + np.where(np.isfinite(top), top, 0.0)
        joint_value = placed_gains(world, image, rest, kinds, joint)
        every = np.concatenate([best[:, None], value, joint_value[:, None]], axis=1)
        where = np.concatenate([poses[:, None], around, joint[:, None]], axis=1)
        chosen = every.argmax(axis=1)
        poses, best = where[np.arange(count), chosen], every[np.arange(count), chosen]
    return Refined(poses, best, sd)


def _deviations(
    curvature: NDArray[np.float64], world: TableWorld, spins: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Standard deviations (B, 3) no wider than the prior's own; 1 / sqrt(2 pi) for what is no parameter."""
    widest = np.array([2 * world.half_m, 2 * world.half_m, 2 * np.pi]) / np.sqrt(2 * np.pi)
    with np.errstate(divide="ignore"):
        sd = np.minimum(np.where(np.isfinite(curvature), -curvature, 0.0) ** -0.5, widest)
    sd[~spins, 2] = 1 / np.sqrt(2 * np.pi)
    return sd
