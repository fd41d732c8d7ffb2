"""Poses of many things refined at once, each in the same surroundings, by halving steps."""

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
AROUND = np.concatenate([np.eye(3), -np.eye(3)])
"""Neighbours, in steps."""
FURTHEST = 1.5
"""Steps to the top of a parabola at most: it was read over one."""
FLAT = 1e-9
"""Least curvature, in nats per square metre or radian."""


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
    spins = np.array([world.kinds[kind].turns != 0 for kind in kinds], np.bool_)
    best = placed_gains(world, image, rest, kinds, poses)
    sd = np.zeros(poses.shape)
    for halving in range(HALVINGS):
        step = FIRST_STEP * 0.5**halving
        around = poses[:, None] + AROUND * step
        value = placed_gains(world, image, rest, np.repeat(kinds, 6), around.reshape(-1, 3)).reshape(-1, 6)
        slope, curvature = _parabolas(best, value, step)
        sd = _deviations(curvature, world, spins)
        top = poses + np.clip(slope / np.maximum(-curvature, FLAT), -FURTHEST * step, FURTHEST * step)
        value_there = placed_gains(world, image, rest, kinds, top)
        every = np.concatenate([best[:, None], value, value_there[:, None]], axis=1)
        where = np.concatenate([poses[:, None], around, top[:, None]], axis=1)
        chosen = (np.arange(len(poses)), every.argmax(axis=1))
        poses, best = where[chosen], every[chosen]
    return Refined(poses, best, sd)


def _parabolas(
    middle: NDArray[np.float64], value: NDArray[np.float64], step: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes and curvatures (B, 3), no upward ones; zero along axes on which a neighbour is impossible."""
    possible = np.isfinite(value[:, :3]) & np.isfinite(value[:, 3:]) & np.isfinite(middle)[:, None]
    up, down = np.where(possible, value[:, :3], 0.0), np.where(possible, value[:, 3:], 0.0)
    centre = np.where(possible, middle[:, None], 0.0)
    return (up - down) / (2 * step), np.minimum(up + down - 2 * centre, 0.0) / step**2


def _deviations(
    curvature: NDArray[np.float64], world: TableWorld, spins: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Standard deviations (B, 3), no wider than the prior's own; 1 / sqrt(2 pi) for what is no parameter."""
    widest = np.array([2 * world.half_m, 2 * world.half_m, 2 * np.pi]) / np.sqrt(2 * np.pi)
    with np.errstate(divide="ignore"):
        sd = np.minimum(np.maximum(-curvature, 0.0) ** -0.5, widest)
    sd[~spins, 2] = 1 / np.sqrt(2 * np.pi)
    return sd
