"""Where candidates are drawn: Gaussians round refined poses, and rejected ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from scene.objects.scene_object import SceneObject
from scene.presence.depth_candidates import PresenceFrames, gain_before, nearest_shown
from scene.presence.gaussian_fits import Fits, climbed, face_factors, fitted
from scene.presence.pose_priors import PosePriors
from scene.presence.size_prior import SizePrior, free_sizes
from scene.presence.state_mixture import StateMixture
from scene.search.importance_sampling import LEAST_SIGMA, distinct
from scene.search.search_result import Initialisation

LEAST_SIZE = 0.002
"""Least standard deviation of the logs of sizes, as that of places."""

SITES = 4
"""Places where an object was not found, of all that are tried, the densest after a turn."""

CLIMBS = 4
"""Turns of climbing to the best place of an object, which was found nearly."""

UNFREE = 1e-6
"""Of steps that change nothing."""

FIRST_STEPS = np.repeat([0.002, 0.02], [6, 3])
"""Of faces (metres) and turns (radians) round poses of the search, refined or not: longer ones leave a good
start."""

DRAWS, TURNS = 48, 2
"""Of a site, and turns of fitting: a covariance in nine dimensions then rests on thirty effective draws."""

TRUST, EVEN = 0.5, 0.2
"""Power of the Gaussians' masses among their weights, and the share of these that is the same for all: what
an object explains alone is not what it explains among others. Of proposals, whose density is divided out:
chosen by hand."""

SPINS, SPIN_WIDTH = 6, 0.6
"""Gaussians round the circle of what is round, and their standard deviation over the step between them: their
sum is then even to 1%."""


def sites_of(
    start: Initialisation, one: int, most: int, known: SceneObject, places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Poses (S, 7) camera_from_box, at most so many, where an object may be but at places where it was found.

    Where the search would put it were it there, where it explains most alone, and the next such places.

    Args:
        start: the best scene of the search, and its pools.
        one: the object's number.
        most: S at most.
        known: the object.
        places: (P, 7) where it was found; none of one that was not.
    """
    pool = start.pools[one]
    ranked = pool[np.argsort(-start.log_alone[one, : len(pool)], kind="stable")]
    every = np.concatenate([start.rivals[one][None], ranked])
    return distinct(every[is_elsewhere(every, places, known)])[:most]


def is_elsewhere(
    poses: NDArray[np.float64], places: NDArray[np.float64], known: SceneObject
) -> NDArray[np.bool_]:
    """Whether an object at poses (S, 7) stands farther from all places (P, 7) than half its middle size."""
    apart_m = np.linalg.norm(poses[:, None, 4:] - places[None, :, 4:], axis=2)
    return (apart_m > np.sort(known.half_extents_m)[1]).all(axis=1)


def born_near(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    sites: Sequence[NDArray[np.float64]],
    lines: NDArray[np.float64],
    places: NDArray[np.integer],
    fits: int,
) -> Iterator[StateMixture]:
    """Mixtures of objects round sites (S, 7) world_from_box of each, fitted so many times to the same tops.

    Gaussians are fitted to what the object explains there beside the others that were found, if it is one of
    these; else alone, for it may be in their place. What was found in the wrong place is moved by them.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of poses and sizes.
        sites: where each of N objects may be, one or more.
        lines: (N, 2, 3) direction and point of the lines about which they are round, zeros without one.
        places: (N,) how many of its sites, the first ones, are where each was found; of the others the best
            are gone on with.
        fits: how many mixtures.
    """
    every = np.repeat(np.arange(len(sites)), [len(one) for one in sites])
    sizes = priors.sizes
    front_m, front_gain = _others(rng, frames, sizes, sites, places > 0)

    def log_densities(owners: NDArray[np.intp], states: NDArray[np.float64]) -> NDArray[np.float64]:
        states = sizes.tied(states, owners)
        each = np.repeat(owners, states.shape[1])
        shown = frames.shown(each, states.reshape(-1, 10), frames.drawn_shapes(rng, len(each)))
        log_likelihood = gain_before(shown, (front_m[each], front_gain[each])).reshape(states.shape[:2])
        log_prior = priors.log_alone(states[..., :7], np.exp(states[..., 7:]))
        log_prior += sizes.log_density(states[..., 7:], owners)
        return log_likelihood + log_prior + priors.log_not_buried(owners, states[..., :7])

    centres = np.concatenate([np.concatenate(sites), sizes.log_half[every]], axis=1)
    owners, centres = _best_of_each(partial(log_densities, every), every, centres, places)
    log_density = partial(log_densities, owners)
    centres = sizes.tied(climbed(log_density, centres, FIRST_STEPS, CLIMBS)[:, None], owners)[:, 0]
    free = np.concatenate([np.ones((len(owners), 6), bool), free_sizes(sizes.ties)[owners]], axis=1)
    for _ in range(fits):
        told = fit_gaussians(rng, log_density, centres, free)
        told = replace(told, centres=sizes.tied(told.centres[:, None], owners)[:, 0])
        yield _mixture(told, owners, lines, sizes)


def fit_gaussians(
    rng: np.random.Generator,
    log_density: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    tops: NDArray[np.float64],
    free: NDArray[np.bool_],
) -> Fits:
    """Gaussians round the tops (n, 10) of a density of boxes or solids (n, S, 10).

    Args:
        rng: random numbers.
        log_density: (n, S).
        tops: where each begins.
        free: (n, 9) which steps change anything.
    """
    least = np.where(free, np.append(LEAST_SIGMA, np.full(3, LEAST_SIZE)), UNFREE)
    return fitted(rng, log_density, tops, face_factors(log_density, tops), least, TURNS, DRAWS)


def _best_of_each(
    log_density: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    owners: NDArray[np.intp],
    centres: NDArray[np.float64],
    places: NDArray[np.integer],
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """The sites of objects owners (n,) from which they go on, after one turn of climbing from each (n, 10).

    The first ones of each, its `places` (N,), and the `SITES` densest of the others.
    """
    centres = climbed(log_density, centres, FIRST_STEPS, 1)
    values, kept = log_density(centres[:, None])[:, 0], []
    for one, count in enumerate(places.tolist()):
        first, others = np.split(np.flatnonzero(owners == one), [count])
        kept += [first, others[np.argsort(-values[others], kind="stable")[:SITES]]]
    chosen = np.concatenate(kept)
    return owners[chosen], centres[chosen]


def _others(
    rng: np.random.Generator,
    frames: PresenceFrames,
    sizes: SizePrior,
    sites: Sequence[NDArray[np.float64]],
    found: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth and log gain (N, X) of what stands beside each of the objects found; +inf and 0 of the rest."""
    front_m = np.full((len(found), frames.pixels), np.inf, np.float32)
    front_gain = np.zeros_like(front_m)
    present = np.flatnonzero(found)
    if len(present) < 2:
        return front_m, front_gain
    states = np.stack([np.append(sites[one][0], sizes.log_half[one]) for one in present.tolist()])
    depth_m, gain = frames.shown(present, states, frames.drawn_shapes(rng, len(present)))
    for row, one in enumerate(present.tolist()):
        beside = (np.delete(part, row, axis=0) for part in (depth_m, gain))
        front_m[one], front_gain[one] = nearest_shown(*beside)
    return front_m, front_gain


def _mixture(
    fits: Fits, owners: NDArray[np.intp], lines: NDArray[np.float64], sizes: SizePrior
) -> StateMixture:
    """Mixtures of objects, with Gaussians (n,) of objects `owners`, and of round ones also spun ones."""
    parts = [_components(fits, np.flatnonzero(owners == one), line) for one, line in enumerate(lines)]
    most = max(len(weights) for weights, *_ in parts)
    log_weights = np.full((len(lines), most), -np.inf)
    centres, factors = np.zeros((len(lines), most, 10)), np.zeros((len(lines), most, 9, 9))
    centres[..., 0], factors[:] = 1.0, np.eye(9)
    fixed = np.concatenate([np.zeros((len(lines), 6), bool), ~free_sizes(sizes.ties)], axis=1)
    for one, (weights, means, covariances) in enumerate(parts):
        log_weights[one, : len(weights)] = np.log(weights)
        centres[one, : len(weights)] = means
        covariances[:, fixed[one]] = covariances[:, :, fixed[one]] = 0.0
        covariances[:, fixed[one], fixed[one]] = 1.0
        factors[one, : len(weights)] = np.linalg.cholesky(covariances)
    return StateMixture(
        log_weights=log_weights, centres=centres, factors=factors, points_m=lines[:, 1], ties=sizes.ties
    )


def _components(
    fits: Fits, mine: NDArray[np.intp], line: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Weights (C,), centres (C, 10) and covariances (C, 9, 9) of the Gaussians of one object."""
    masses = fits.log_masses[mine]
    weights = (1 - EVEN) * softmax(TRUST * masses) + EVEN / len(mine)
    centres, factors = fits.centres[mine], fits.factors[mine]
    rotations = Rotation.from_quat(centres[:, :4], scalar_first=True).as_matrix()
    change = np.tile(np.eye(9), (len(mine), 1, 1))  # offsets are those of the line's point
    change[:, :3, 3:6] = -rotations @ np.cross(line[1], np.eye(3)).T
    covariances = change @ factors @ np.swapaxes(factors, 1, 2) @ np.swapaxes(change, 1, 2)
    if not line[0].any():
        return weights, centres, covariances
    angles = 2 * np.pi * np.arange(SPINS) / SPINS
    turns = Rotation.from_rotvec(angles[:, None] * line[0]).as_matrix()
    spun = np.repeat(centres[:, None], SPINS, axis=1)
    turned = rotations[:, None] @ turns
    spun[..., :4] = (
        Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_quat(scalar_first=True).reshape(len(mine), SPINS, 4)
    )
    spun[..., 4:7] += (rotations @ line[1])[:, None] - turned @ line[1]
    about = np.tile(np.eye(9), (SPINS, 1, 1))
    about[:, 3:6, 3:6] = np.swapaxes(turns, 1, 2)
    wide = about @ covariances[:, None] @ np.swapaxes(about, 1, 2)
    wide[..., 3:6, 3:6] += (SPIN_WIDTH * 2 * np.pi / SPINS) ** 2 * np.outer(line[0], line[0])
    half = 0.5 * weights
    return (
        np.concatenate([half, np.repeat(half / SPINS, SPINS)]),
        np.concatenate([centres, spun.reshape(-1, 10)]),
        np.concatenate([covariances, wide.reshape(-1, 9, 9)]),
    )
