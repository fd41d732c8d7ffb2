"""Poses of many things refined at once, each in the same surroundings, by Gauss-Newton steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.colour.density import FITS_OF_MANY, fit, sums
from scene.colour.rendering import SAMPLES, Layers, Motion, Neighbours, render_with_motion
from scene.colour.surroundings import Placed, Surroundings, forbidden, pushed_out
from scene.colour.world import TableWorld

LONGEST_STEP = np.array([0.015, 0.015, 0.4])
"""Three quarters of a lattice cell: metres, metres, radians."""
BLURS = (8.0, 4.0, 2.0)
"""Times the noise with which residuals are judged in the first steps: outlines that are a pixel off are
outliers by the noise itself, and would pull at nothing."""
TURNED = (2.0,)
"""Of a thing whose place is right."""
COMPARED_AT = 2.0
"""Blur from which on gains tell which start is the better one."""
BEHIND_NATS = 100.0
"""A start whose gain is less than the best rival's, or than none, by so much more than its step promises,
is left."""
LEAST_GAIN = -1e9
"""In place of what may not stand."""
SHARP_STEPS = 4
"""Most steps with the noise itself, ..."""
WORTH_NATS = 0.5
"""... as long as one of them gains so much."""


ROCKED = (-3.0, -1.5, 1.5, 3.0)
"""Deviations of a yaw by which things are shaken at last: edges in a thing have other places a pixel on."""
SHAKEN = 0.7 * np.random.default_rng(0).standard_normal((4, 3))
"""Deviations of poses likewise: as pixels' samples pass from one triangle to the next, gains are rough by
some nats within a deviation."""


@dataclass(frozen=True, eq=False)
class Refined:
    """Poses at which gains are greatest nearby.

    Attributes:
        which: (B,) of those from where it began, ascending.
        poses: (B, 3).
        gains: (B,) log.
        covariance: (B, 3, 3) of a Gaussian with the curvature there, no wider than the prior.
    """

    which: NDArray[np.int64]
    poses: NDArray[np.float64]
    gains: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def log_evidence(self) -> NDArray[np.float64]:
        """Of poses under the Gaussian (B,), up to a constant."""
        return self.gains + 0.5 * np.linalg.slogdet(self.covariance)[1]


@dataclass(frozen=True, eq=False)
class _Steps:
    """From poses (B,).

    Attributes:
        gains: (B,) at the poses.
        steps: (B, 3).
        covariance: (B, 3, 3).
        promise: (B,) nats that the steps gain if the curvature goes on.
    """

    gains: NDArray[np.float64]
    steps: NDArray[np.float64]
    covariance: NDArray[np.float64]
    promise: NDArray[np.float64]


def refine(
    world: TableWorld,
    around: Surroundings,
    kinds: NDArray[np.int64],
    poses: NDArray[np.float64],
    images: NDArray[np.int64],
    rivals: NDArray[np.int64],
    wanted: int,
    blurs: tuple[float, ...] = BLURS,
) -> Refined:
    """Climb from `poses` (B, 3), each in its image (B,) of the surroundings.

    From the last blurred steps on those that are well behind the best of their `rivals` (B,) are left, and
    the worse half, but for as many as are wanted of each set.
    """
    poses = poses.copy()
    for number, scene in enumerate(around.scenes):
        mine = images == number
        poses[mine] = pushed_out(world, scene, kinds[mine], poses[mine])
    going, middle = np.arange(len(kinds)), poses.copy()
    best, covariance = np.full(len(kinds), LEAST_GAIN), np.tile(np.eye(3), (len(kinds), 1, 1))
    for blur in (*blurs, *[1.0] * SHARP_STEPS):
        here = _stepped(world, around, kinds[going], middle[going], images[going], blur)
        step, value, done = here.steps, here.gains, False
        if blur == 1.0:
            gained = np.maximum(here.gains, LEAST_GAIN) - best[going]
            better = gained > 0
            up = going[better]
            poses[up], best[up], covariance[up] = middle[up], here.gains[better], here.covariance[better]
            step = np.where(better[:, None], step, (poses[going] - middle[going]) / 2)
            value, done = best[going], bool((np.minimum(gained, here.promise) < WORTH_NATS).all())
        if blur <= COMPARED_AT:
            keep = _leading(value, here.promise, rivals[going], wanted)
            going, step = going[keep], step[keep]
        if done or not len(going):
            break
        middle[going] += step
        for number, scene in enumerate(around.scenes):
            mine = going[images[going] == number]
            middle[mine] = pushed_out(world, scene, kinds[mine], middle[mine])
    return Refined(going, poses[going], best[going], covariance[going])


def shaken(
    world: TableWorld,
    around: Surroundings,
    kinds: NDArray[np.int64],
    poses: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The best of each pose (B, 3) and a few near it by its covariance (B, 3, 3).

    Thing b stands in image b of the surroundings.
    """
    ridge = covariance[:, :, 2] / np.sqrt(covariance[:, 2:, 2])
    offsets = [np.zeros((len(kinds), 1, 3)), np.array(ROCKED)[:, None] * ridge[:, None]]
    tried = poses[:, None] + np.concatenate(
        [*offsets, SHAKEN @ np.linalg.cholesky(covariance).swapaxes(1, 2)], axis=1
    )
    things, each = tried.shape[:2]
    images = np.repeat(np.arange(things), each)
    here = _stepped(world, around, np.repeat(kinds, each), tried.reshape(-1, 3), images, 1.0)
    return tried[np.arange(things), here.gains.reshape(things, each).argmax(axis=1)]


def _leading(
    gains: NDArray[np.float64], promise: NDArray[np.float64], rivals: NDArray[np.int64], wanted: int
) -> NDArray[np.int64]:
    """Of each set of rivals (B,) the better half, or as many as are wanted, that are not well behind."""
    kept = []
    for one in np.unique(rivals):
        mine = np.flatnonzero(rivals == one)
        mine = mine[np.argsort(-gains[mine])]
        least = max(gains[mine[0]], 0.0) - BEHIND_NATS
        mine = mine[: max(-(-len(mine) // 2), wanted)]
        kept.append(mine[gains[mine] + 2 * promise[mine] > least])
    return np.sort(np.concatenate(kept))


def _stepped(
    world: TableWorld,
    around: Surroundings,
    kinds: NDArray[np.int64],
    poses: NDArray[np.float64],
    images: NDArray[np.int64],
    blur: float,
) -> _Steps:
    """One Gauss-Newton step of each, with albedos that follow."""
    layers, motion = render_with_motion(world, kinds, poses, 1 if blur > 1.0 else SAMPLES)
    noise = world.noise.blurred(blur)
    placed = Placed.of(world, around, layers, images, rough=blur > 1.0)
    segments = placed.segments
    fitted = fit(segments, noise, steps=FITS_OF_MANY)
    factor = fitted.factor[segments.owner]
    contrast = placed.free * segments.lit * factor - placed.behind
    lit_change = _lit_change(world, layers, motion, around.image.colour.shape[1])
    change = motion.fill[:, :, None] * contrast[:, None] + (segments.share * factor)[:, None] * lit_change
    change[:, 2] *= ~world.spins[kinds][segments.owner, None]
    weighed = change * fitted.weight[:, None]
    slope = sums(segments.start, np.einsum("pkc,pc->pk", weighed, fitted.residual))
    shared = sums(segments.start, weighed * segments.own[:, None])
    curvature = sums(segments.start, weighed @ change.swapaxes(1, 2))
    curvature -= np.einsum("bkc,blc,bc->bkl", shared, shared, 1 / fitted.precision)
    barred = np.zeros(len(kinds), np.bool_)
    for number, scene in enumerate(around.scenes):
        mine = images == number
        barred[mine] = forbidden(world, scene, kinds[mine], poses[mine])
    covariance = np.linalg.inv(curvature + _least_curvature(world, world.spins[kinds]))
    step = np.einsum("bij,bj->bi", covariance, slope)
    return _Steps(
        gains=np.where(barred, -np.inf, placed.gains(noise, fitted)),
        steps=np.clip(step, -LONGEST_STEP, LONGEST_STEP),
        covariance=covariance,
        promise=0.5 * (slope * step).sum(axis=1),
    )


def _lit_change(world: TableWorld, layers: Layers, motion: Motion, channels: int) -> NDArray[np.float64]:
    """(P, 3, C) change of lit colours with x, y and yaw: what is seen moves, and its triangle turns."""
    across, down = Neighbours.of(layers, world.camera).slopes(layers.lit(channels))
    turning = motion.shade[:, :, None] * layers.tint_of(channels)[:, None]
    velocity = motion.velocity
    return turning - velocity[:, :, :1] * across[:, None] - velocity[:, :, 1:] * down[:, None]


def _least_curvature(world: TableWorld, spins: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Of Gaussians (B, 3, 3) with the prior's height; 2 pi for a yaw that is no parameter."""
    widest = np.array([2 * world.half_m, 2 * world.half_m, 2 * np.pi])
    curvature = np.tile(2 * np.pi / widest**2, (len(spins), 1))
    curvature[spins, 2] = 2 * np.pi
    return curvature[:, None] * np.eye(3)
