"""Refinement of poses: particles of each found object's posterior given the others, as chains will see it.

A sequential Monte Carlo sampler (Del Moral, Doucet and Jasra 2006): particles round the search's poses and
what looks like them are weighted, resampled and moved while the exponent of the likelihood rises from 0 to 1.
The posterior is narrow and rough: a pixel at an outline that changes sides costs some nats, several times a
millimetre. What climbs, and chains of a hundred sweeps, stay in the first narrow place, tens of nats below
the others. The density is that of chains and presence, of all frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from scene.config import ParseConfig
from scene.likelihood.compared_frames import ComparedFrames
from scene.likelihood.object_renderer import ObjectRenderer
from scene.mcmc.chain_model import carrying
from scene.mcmc.local_multiple_try import LEAST_SPIN_RAD, MOST_SPIN_RAD, SPIN_SHARE
from scene.objects.scene_object import SceneObject
from scene.objects.symmetry import turns_alike
from scene.presence.depth_candidates import PresenceFrames, gain_before, nearest_shown
from scene.presence.pose_priors import PosePriors
from scene.search.importance_sampling import distinct, largest_power
from scene.search.search_result import Initialisation
from shapes.geometry.poses import matrices_of, poses_of
from shapes.resampling import draw_systematically

PARTICLES, MOVES = 128, 4
"""Of an object, and moves at each exponent: of 16 objects drawn from the model two end over six nats below
the truth, with 48 particles or two moves every third by ten or more."""

ALIVE = 0.7
"""Effective share of particles that a step of the exponent leaves: with 0.8 as many of 16 objects end near
the truth, in a third more time."""

FIRST_SIGMA, CLOSE, CLOSE_SHARE = np.repeat([0.004, 0.05], 3), 0.25, 0.5
"""Standard deviations of first particles about the search's poses, of offsets and turns, and of a share
that is closer."""

LEAST_SIGMA = np.repeat([2e-5, 2e-4], 3)
"""Standard deviations added to those of steps: a tenth of what pixels tell, so that no step is nothing."""

SMALLEST, LARGEST = 0.15, 1.0
"""Scales of steps over the particles' standard deviations, log-uniform between these."""

WORSE, SOUGHT = 25.0, 8
"""Nats by which a pose in the pool may be worse to be a start, and how many of these are."""

MOST_SEEDS = PARTICLES // 4
"""So that some particles are round each."""


def refine_poses(
    rng: np.random.Generator,
    compared: ComparedFrames,
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    start: Initialisation,
    config: ParseConfig,
) -> NDArray[np.float64]:
    """Particles (N, PARTICLES, 7) world_from_box of each object, the densest first.

    Objects are refined one after another, the others at their best. Those that were not found stay.

    Args:
        rng: random numbers.
        compared: the frames.
        objects: all N.
        renderer: of these.
        start: the best scene, and its pools, in the searched frame's camera.
        config: settings.
    """
    world_from_camera = compared.world_from_camera
    best = poses_of(world_from_camera @ matrices_of(start.poses))
    particles = np.repeat(best[:, None], PARTICLES, axis=1)
    supports = carrying(compared.data.supports, objects, start)
    priors = PosePriors.over(compared, supports, objects, len(objects), best[start.found, 4:], config)
    frames = PresenceFrames(compared=compared, renderer=renderer, log_half=priors.sizes.log_half)
    for one in np.flatnonzero(start.found).tolist():
        log_density = _log_density_beside(frames, priors, one, best, start.found)
        seeds = poses_of(world_from_camera @ matrices_of(_seeds(start, objects[one], one)))
        poses, log_densities = anneal(
            rng,
            log_density,
            seeds,
            Steps(line=objects[one].spin_line, spins_freely=objects[one].spins_freely),
        )
        particles[one] = poses[np.argsort(-log_densities, kind="stable")]
        best[one] = particles[one, 0]
    return particles


def _seeds(start: Initialisation, known: SceneObject, one: int) -> NDArray[np.float64]:
    """Poses (S, 7) camera_from_box: the best one, those in the pool that are about as good, lookalikes."""
    pool, gains = start.pools[one], start.log_gains[one, : len(start.pools[one])]
    order = np.argsort(-gains, kind="stable")
    poses = distinct(np.concatenate([start.poses[one][None], pool[order[gains[order] > -WORSE]]]))[:SOUGHT]
    spun = np.zeros((2, 3)) if known.spins_freely else known.spin_line
    alike = turns_alike(known.symmetry_lines, known.symmetry_orders, spun)
    return distinct(poses_of((matrices_of(poses)[:, None] @ alike[None]).reshape(-1, 4, 4)))[:MOST_SEEDS]


LogDensity = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Log likelihood and log prior (S,) of poses (S, 7)."""


def _log_density_beside(
    frames: PresenceFrames,
    priors: PosePriors,
    one: int,
    best: NDArray[np.float64],
    found: NDArray[np.bool_],
) -> LogDensity:
    """That of one object over the scene without it, beside all others `found` (N,) at poses `best` (N, 7)."""
    front = np.full(frames.pixels, np.inf, np.float32), np.zeros(frames.pixels, np.float32)
    others = np.flatnonzero(found & (np.arange(len(found)) != one))
    if len(others):
        states = np.concatenate([best[others], frames.log_half[others]], axis=1)
        front = nearest_shown(*frames.shown(others, states))

    def log_density(poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        owners, log_half = np.full(len(poses), one), frames.log_half[one]
        states = np.concatenate([poses, np.tile(log_half, (len(poses), 1))], axis=1)
        shown = frames.shown(owners, states)
        half_m = np.tile(np.exp(log_half), (1, len(poses), 1))
        log_prior = priors.log_alone(poses[None], half_m)[0]
        log_prior += priors.log_not_buried(np.array([one]), poses[None])[0]
        for other in others.tolist():
            log_prior += priors.log_apart(one, poses, other, best[other])
        return gain_before(shown, front), log_prior

    return log_density


def anneal(
    rng: np.random.Generator, log_density: LogDensity, seeds: NDArray[np.float64], steps: Steps
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Particles (PARTICLES, 7) of a posterior of one pose, and their log densities (PARTICLES,).

    Exponents rise by what leaves `ALIVE` of the particles (Jasra et al. 2011). Moves are Metropolis steps
    with the covariance of the particles about the best of those that came from the same seed. They are
    symmetric, in offsets of a point of the object and turns along the world's axes.

    Args:
        rng: random numbers.
        log_density: of poses, in any measure that turns and offsets preserve.
        seeds: (S, 7) round which the first particles are.
        steps: that the object takes.
    """
    seed = np.arange(PARTICLES) % len(seeds)
    wide = np.where(rng.random((PARTICLES, 1)) < CLOSE_SHARE, CLOSE, 1.0)
    wide[: len(seeds)] = 0.0
    poses = steps.moved(seeds[seed], wide * FIRST_SIGMA * rng.standard_normal((PARTICLES, 6)))
    log_likelihood, log_prior = log_density(poses)
    exponent = 0.0
    while exponent < 1:
        rise = largest_power(log_likelihood, ALIVE * PARTICLES, 1 - exponent)
        exponent = min(exponent + rise, 1.0)
        kept = draw_systematically(rng, softmax(rise * log_likelihood), PARTICLES)
        poses, seed = poses[kept], seed[kept]
        log_likelihood, log_prior = log_likelihood[kept], log_prior[kept]
        for _ in range(MOVES if exponent < 1 else 2 * MOVES):
            log_now = exponent * log_likelihood + log_prior
            offered = steps.drawn(rng, poses, steps.factor(poses, seed, log_now))
            likelihood_there, prior_there = log_density(offered)
            log_ratio = exponent * likelihood_there + prior_there - log_now
            accepted = np.log(rng.random(PARTICLES)) < log_ratio
            poses = np.where(accepted[:, None], offered, poses)
            log_likelihood = np.where(accepted, likelihood_there, log_likelihood)
            log_prior = np.where(accepted, prior_there, log_prior)
    return poses, log_likelihood + log_prior


@dataclass(frozen=True, kw_only=True, eq=False)
class Steps:
    """Symmetric steps of one object's pose.

    Attributes:
        line: (2, 3) direction and point of the line about which it is round; zeros without one.
        spins_freely: whether nothing tells the spin about it.
    """

    line: NDArray[np.float64]
    spins_freely: bool

    def moved(self, poses: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.float64]:
        """Poses (S, 7) after steps (S, 6): offsets of the line's point, turns along the world's axes."""
        return _about(poses, steps, self.line, np.zeros(len(poses)))

    def drawn(
        self, rng: np.random.Generator, poses: NDArray[np.float64], factor: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Poses (S, 7) one step on, by a lower factor (6, 6) of the steps' covariance."""
        count = len(poses)
        scale = SMALLEST * (LARGEST / SMALLEST) ** rng.random((count, 1))
        steps = scale * (rng.standard_normal((count, 6)) @ factor.T)
        if self.spins_freely:
            widest = LEAST_SPIN_RAD * (MOST_SPIN_RAD / LEAST_SPIN_RAD) ** rng.random(count)
            spins = np.where(rng.random(count) < SPIN_SHARE, widest * rng.standard_normal(count), 0.0)
            return _about(poses, steps, self.line, spins)
        return self.moved(poses, steps)

    def factor(
        self, poses: NDArray[np.float64], seed: NDArray[np.integer], log_densities: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Lower factor (6, 6) of the covariance of poses (S, 7) within those of one seed (S,), pooled."""
        spread = np.zeros((len(poses), 6))
        for one in np.unique(seed):
            mine = np.flatnonzero(seed == one)
            best = poses[mine[log_densities[mine].argmax()]]
            steps = self._between(best, poses[mine])
            spread[mine] = steps - steps.mean(axis=0)
        covariance = spread.T @ spread / len(poses) + np.diag(LEAST_SIGMA**2)
        return np.asarray(np.linalg.cholesky(covariance), np.float64)

    def _between(self, centre: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Steps (S, 6) from one pose (7,) to poses (S, 7), without the spin where nothing tells it."""
        before, after = _rotation(centre), _rotation(poses)
        direction, point = self.line
        offsets = poses[:, 4:] + after.apply(point) - centre[4:] - before.apply(point)
        if self.spins_freely:
            x, y, z, w = (before.inv() * after).as_quat().T
            angles = 2 * np.arctan2(np.stack([x, y, z], axis=1) @ direction, w)
            after *= Rotation.from_rotvec(-angles[:, None] * direction)
        return np.concatenate([offsets, (after * before.inv()).as_rotvec()], axis=1)


def _about(
    poses: NDArray[np.float64],
    steps: NDArray[np.float64],
    line: NDArray[np.float64],
    angles: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Poses (S, 7) spun by angles (S,) about a line (2, 3) of the box, then moved by steps (S, 6)."""
    before = _rotation(poses)
    after = Rotation.from_rotvec(steps[:, 3:]) * before * Rotation.from_rotvec(angles[:, None] * line[0])
    places = poses[:, 4:] + before.apply(line[1]) + steps[:, :3] - after.apply(line[1])
    return np.concatenate([after.as_quat(scalar_first=True), places], axis=1)


def _rotation(poses: NDArray[np.float64]) -> Rotation:
    return Rotation.from_quat(poses[..., :4], scalar_first=True)
