"""Where candidates are drawn: Gaussians round states of chains, rejected poses, and unknown solids there."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.mcmc.mixture_init import of_points, own_components
from scene.mcmc.pose_mixture import PoseMixture
from scene.mcmc.symmetry_arrays import SpinLines
from scene.presence.depth_candidates import PresenceFrames
from scene.presence.gaussian_fits import climbed, fitted
from scene.presence.pose_priors import PosePriors
from scene.presence.solids import (
    FREE_OF_CYLINDERS,
    GREATEST_M,
    LEAST_M,
    SolidFits,
    log_sizes_density,
    tied,
    upright,
)
from scene.search.importance_sampling import FIRST_SIGMA, LEAST_SIGMA, MODES, apart
from scene.search.search_result import Initialisation

LEAST_DENSITY = 1e-30
"""Of the prior where it excludes a pose: what is fitted may still come to where it does not."""

SOLID_M, SOLID_RAD, LEAST_SIZE = 0.002, 0.015, 0.002
"""First standard deviations of a solid's place and sizes, and of its turn; least one of the logs of sizes."""

CLIMBS, SOLID_TURNS, SOLID_DRAWS = 10, 2, 32
"""Turns of climbing to a solid's best place, and of the fit there with its draws."""

UNFREE = 1e-6
"""Of steps that change nothing."""

NEAR_M, NEAR_RAD = 0.002, 0.02
"""First standard deviations round states of chains."""

DRAWS, TURNS = 20, 2
"""Of a site; a third of what refinement takes, whose Gaussians start chains."""


def sites_of(start: Initialisation, one: int, count: int) -> NDArray[np.float64]:
    """Poses (count, 7) camera_from_box where an object may be that was not found.

    Where the search would put it were it there, where it explains most alone, and the next such places.
    """
    pool = start.pools[one]
    ranked = pool[np.argsort(-start.log_alone[one, : len(pool)], kind="stable")]
    sites = start.rivals[one][None]
    for pose in ranked:
        if len(sites) == count:
            break
        if apart(pose, sites, 1.0).all():
            sites = np.append(sites, pose[None], axis=0)
    return np.resize(sites, (count, 7))


def born_near(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    sites: NDArray[np.float64],
    lines: SpinLines,
    sampled: NDArray[np.bool_],
) -> PoseMixture:
    """Mixtures of objects round sites (N, S, 7) world_from_box.

    Gaussians are fitted to what the object explains there alone, by importance sampling in some turns.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of poses.
        sites: where they may be.
        lines: about which they are round.
        sampled: (N,) whether the sites are where chains ended, so that Gaussians begin narrow.
    """
    owners = np.repeat(np.arange(len(sites)), sites.shape[1])

    def log_density(poses: NDArray[np.float64]) -> NDArray[np.float64]:
        _, gain = frames.shown(rng, np.repeat(owners, poses.shape[1]), poses.reshape(-1, 7))
        log_alone = gain.sum(axis=1, dtype=np.float64).reshape(poses.shape[:2])
        half_m = np.repeat(priors.half_m[owners][:, None], poses.shape[1], axis=1)
        return log_alone + np.log(np.maximum(priors.alone(poses, half_m), LEAST_DENSITY))

    first = np.where(sampled[owners, None], np.repeat([NEAR_M, NEAR_RAD], 3), FIRST_SIGMA)
    wide = first[:, :, None] * np.eye(6)
    centres, factors = fitted(rng, log_density, sites.reshape(-1, 7), wide, LEAST_SIGMA, TURNS, DRAWS)
    return _mixture(centres, factors, lines, sites.shape[1])


def solids_near(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    boxes: NDArray[np.float64],
    axes: NDArray[np.integer],
) -> SolidFits:
    """Unknown solids in the places of objects: what else might be seen there.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of poses.
        boxes: (n, 10) world_from_box and logs of half sizes of the objects' boxes.
        axes: (n,) the box axis about which each is round: then a cylinder stands there; -1 of others: a box.
    """
    starts = upright(boxes, axes)
    starts[:, 7:] = np.clip(starts[:, 7:], np.log(LEAST_M), np.log(GREATEST_M))
    centres, factors = np.zeros_like(starts), np.zeros((len(starts), 9, 9))
    for kind in (False, True):
        mine = np.flatnonzero((axes >= 0) == kind)
        if len(mine):
            log_density = partial(_log_alone, frames, priors, kind)
            best = climbed(log_density, starts[mine], CLIMBS)
            free = FREE_OF_CYLINDERS if kind else np.ones(9)
            sizes = np.maximum(np.exp(best[:, 7:]), LEAST_M)
            first = np.tile(np.repeat([SOLID_M, SOLID_RAD], 3), (len(mine), 1))
            first = np.where(free, np.concatenate([first, SOLID_M / sizes], axis=1), UNFREE)
            least = np.where(free, np.append(LEAST_SIGMA, np.full(3, LEAST_SIZE)), UNFREE)
            wide = first[:, :, None] * np.eye(9)
            found = fitted(rng, log_density, best, wide, least, SOLID_TURNS, SOLID_DRAWS)
            centres[mine], factors[mine] = found
    centres = tied(centres[:, None], axes >= 0)[:, 0]
    return SolidFits(is_round=axes >= 0, centres=centres, factors=factors)


def _log_alone(
    frames: PresenceFrames, priors: PosePriors, is_round: bool, states: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Log density (n, S) of solids (n, S, 10) of one kind, alone in the scene."""
    rounds = np.full(len(states), is_round)
    states = tied(states, rounds)
    _, gain = frames.shown_solids(states.reshape(-1, 10), np.repeat(rounds, states.shape[1]))
    poses, log_half = states[..., :7], states[..., 7:]
    log_alone = gain.sum(axis=1, dtype=np.float64).reshape(states.shape[:2])
    log_alone += np.log(np.maximum(priors.alone(poses, np.exp(log_half)), LEAST_DENSITY))
    return log_alone + np.maximum(log_sizes_density(log_half, rounds[:, None]), np.log(LEAST_DENSITY))


def _mixture(
    centres: NDArray[np.float64], factors: NDArray[np.float64], lines: SpinLines, sites: int
) -> PoseMixture:
    """Mixtures of objects with so many Gaussians each, of round ones spun round the circle."""
    count = len(centres) // sites
    even = np.full((len(centres), MODES), -np.log(MODES))
    at, spread = (
        np.repeat(part[:, None], MODES, axis=1) for part in (centres, factors @ np.swapaxes(factors, 1, 2))
    )
    with jax.enable_x64(True):
        each = jax.tree.map(lambda leaf: jnp.repeat(leaf, sites, axis=0), lines)
        about = jax.vmap(of_points)(jnp.asarray(spread), jnp.asarray(at), each.points_m)
        parts = jax.vmap(own_components)(jnp.asarray(even), jnp.asarray(at), about, each)
        log_weights, means, covariances = (leaf.reshape(count, -1, *leaf.shape[2:]) for leaf in parts)
        return PoseMixture.build(log_weights, means, covariances, lines.points_m)
