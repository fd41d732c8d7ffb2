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
COARSE = range(5)
"""Halvings of it; the last step is 0.6 mm and one degree, ..."""
FINE = range(3, 7)
"""... and 0.16 mm where a scene is polished at last: a tenth of a pixel in most cameras."""
AROUND = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
"""The middle and its neighbours, in steps."""
FURTHEST = 1.5
"""Steps to the top of a parabola at most: it was read over one."""
FLAT = 1e-9
"""Least curvature, in nats per square metre or radian."""


@dataclass(frozen=True, eq=False)
class Refined:
    """Poses at which gains are greatest nearby.

    Attributes:
        which: (B,) of those from where it began, ascending.
        poses: (B, 3).
        gains: (B,) log.
        sd: (B, 3) of a Gaussian with the curvature there, axes apart; of the prior at most.
    """

    which: NDArray[np.int64]
    poses: NDArray[np.float64]
    gains: NDArray[np.float64]
    sd: NDArray[np.float64]


def refine(
    world: TableWorld,
    image: ColourImage,
    rest: Surroundings,
    kinds: NDArray[np.int64],
    poses: NDArray[np.float64],
    wanted: int,
    halvings: range = COARSE,
) -> Refined:
    """Climb from `poses` (S, 3): parabolas through the six neighbours tell where to look next.

    After each step the better half goes on (successive halving), but no fewer than are wanted.
    """
    spins = np.array([world.kinds[kind].turns != 0 for kind in kinds], np.bool_)
    poses, best = poses.copy(), np.full(len(poses), -np.inf)
    middle, sd, going = poses.copy(), np.zeros(poses.shape), np.arange(len(poses))
    for halving in halvings:
        step = FIRST_STEP * 0.5**halving
        tried = middle[going, None] + AROUND * step
        value = placed_gains(world, image, rest, np.repeat(kinds[going], 7), tried.reshape(-1, 3)).reshape(
            -1, 7
        )
        slope, curvature = _parabolas(value[:, 0], value[:, 1:], step)
        sd[going] = _deviations(curvature, world, spins[going])
        top = np.clip(slope / np.maximum(-curvature, FLAT), -FURTHEST * step, FURTHEST * step)
        every = np.concatenate([best[going, None], value], axis=1)
        where = np.concatenate([poses[going, None], tried], axis=1)
        chosen = (np.arange(len(going)), every.argmax(axis=1))
        poses[going], best[going] = where[chosen], every[chosen]
        worse = chosen[1] == 0  # than before: the last parabola led astray
        middle[going] = np.where(worse[:, None], poses[going], middle[going] + top)
        going = np.sort(going[np.argsort(-best[going])[: max(-(-len(going) // 2), wanted)]])
    value = placed_gains(world, image, rest, kinds[going], middle[going])
    better = value > best[going]
    poses[going[better]], best[going[better]] = middle[going[better]], value[better]
    return Refined(going, poses[going], best[going], sd[going])


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
