"""Gaussians fitted by adaptive multiple importance sampling (Cornuet, Marin, Mira and Robert 2012)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from scene.search.importance_sampling import WIDER, moments, tempered

ALIVE = 1 / 3
"""Effective number of draws to which weights are tempered, over the draws of a turn."""

LEAST_STEPS = np.repeat([0.0005, 0.002], [6, 3])
"""Least steps of a box's faces (metres) and of its turns (radians) in a search, ..."""
LONGER, SHORTER, FURTHEST = 1.3, 0.5, 2.0
"""... which grow where they lead up and shrink where they do not; most steps to the top of a parabola."""
FIRST_WIDTHS = np.repeat([0.002, 0.02], [6, 3])
"""Standard deviations of faces and turns that are tried first where the curvature is sought, ..."""
WIDTHS_TRIED, LEAST_FALL = 3, 0.05
"""... how often they are corrected to where the density falls by half a nat, by a tenth at least of what it
falls, so that one that hardly falls grows threefold, ..."""
LEAST_WIDTHS, LARGEST_WIDTHS = np.repeat([2e-4, 1e-3], [6, 3]), np.repeat([0.02, 0.3], [6, 3])
"""... and their bounds: what pixels tell, and what a hand's breadth leaves open."""
FLATTEST, THINNER = 1e-9, 0.2
"""Least curvature, and least share of a half size that a step leaves."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fits:
    """n Gaussians.

    Attributes:
        centres: (n, 7 + D) states.
        factors: (n, 6 + D, 6 + D) lower factors of offsets in the world, turns on the right, other numbers.
        log_masses: (n,) log integrals of what they are fitted to, as the draws tell them.
    """

    centres: NDArray[np.float64]
    factors: NDArray[np.float64]
    log_masses: NDArray[np.float64]


def fitted(
    rng: np.random.Generator,
    log_density: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    centres: NDArray[np.float64],
    factors: NDArray[np.float64],
    least: NDArray[np.float64],
    turns: int,
    draws: int,
) -> Fits:
    """Gaussians, all fitted side by side, each in steps from where it began.

    Args:
        rng: random numbers.
        log_density: of states (n, S, 7 + D), (n, S).
        centres: first ones: poses, then D other numbers.
        factors: first ones.
        least: (n, 6 + D) or (6 + D,) standard deviations that are added.
        turns: of fitting.
        draws: of a Gaussian in each; all turns' draws count in all fits to come.
    """
    means, size = np.zeros(factors.shape[:2]), factors.shape[1]
    steps, log_target = np.zeros((len(centres), 0, size)), np.zeros((len(centres), 0))
    offered: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    log_weights = log_target
    for _ in range(turns):
        offered.append((means, factors))
        normal = rng.standard_normal((len(centres), draws, size))
        fresh = means[:, None] + np.einsum("nij,nsj->nsi", factors, normal)
        steps = np.concatenate([steps, fresh], axis=1)
        log_target = np.concatenate([log_target, log_density(moved(centres, fresh))], axis=1)
        log_weights = log_target - _log_offered(steps, offered)
        means, covariances = moments(steps, np.stack([tempered(one, draws * ALIVE) for one in log_weights]))
        covariances[:, np.arange(size), np.arange(size)] += least**2
        factors = np.asarray(WIDER * np.linalg.cholesky(covariances), np.float64)
    masses = logsumexp(log_weights, axis=1) - np.log(log_weights.shape[1])
    return Fits(centres=moved(centres, means[:, None])[:, 0], factors=factors, log_masses=masses)


def _log_offered(
    steps: NDArray[np.float64], offered: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]
) -> NDArray[np.float64]:
    """Log densities (n, S) of steps (n, S, d) under the even mixture of what they were drawn from."""
    of_each = np.stack([_log_normal(steps, *one) for one in offered])
    return np.asarray(logsumexp(of_each, axis=0) - np.log(len(offered)))


def _log_normal(
    steps: NDArray[np.float64], means: NDArray[np.float64], factors: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Log densities (n, S) of steps (n, S, d) under Gaussians: means (n, d), lower factors (n, d, d)."""
    white = np.linalg.solve(factors, np.swapaxes(steps - means[:, None], 1, 2))
    log_volume = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
    return -0.5 * (white**2).sum(axis=1) - (log_volume + 0.5 * means.shape[1] * np.log(2 * np.pi))[:, None]


def climbed(
    log_density: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    solids: NDArray[np.float64],
    first: NDArray[np.float64],
    turns: int,
) -> NDArray[np.float64]:
    """The densest boxes (n, 10), poses and logs of half sizes, that are met on the way up.

    A pattern search (Hooke and Jeeves 1961): each turn every face and every turn is moved either way; what
    leads up is then tried together, as far as the parabolas through three points say.

    Args:
        log_density: of states (n, S, 10), (n, S).
        solids: where the search begins.
        first: (9,) first steps of the faces, as `reshaped` takes them, and of the turns.
        turns: of the search.
    """
    steps = np.tile(first, (len(solids), 1))
    best, value = solids, log_density(solids[:, None])[:, 0]
    for _ in range(turns):
        best, value, steps = _climbed_once(log_density, best, value, steps)
    return best


def _climbed_once(
    log_density: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    solids: NDArray[np.float64],
    value: NDArray[np.float64],
    steps: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A turn of `climbed`: denser boxes (n, 10), their log densities (n,), and the next steps (n, 9)."""
    probes = steps[:, None] * np.concatenate([np.eye(9), -np.eye(9)])
    options = reshaped(solids, probes)
    values = log_density(options)
    up, down = values[:, :9], values[:, 9:]
    leads_up = np.maximum(up, down) > value[:, None]
    towards = np.where(leads_up, np.sign(up - down), 0.0)
    curvature = np.minimum(up + down - 2 * value[:, None], 0.0)
    tops = np.clip((up - down) / 2 / np.maximum(-curvature, FLATTEST), -FURTHEST, FURTHEST)
    tops = np.where(curvature < 0, tops, FURTHEST * towards)
    together = np.stack([tops, 0.5 * tops, towards, 0.5 * towards, tops * leads_up], axis=1)
    combined = reshaped(solids, together * steps[:, None])
    options = np.concatenate([solids[:, None], options, combined], axis=1)
    values = np.concatenate([value[:, None], values, log_density(combined)], axis=1)
    chosen = np.arange(len(solids)), values.argmax(axis=1)
    steps = np.maximum(steps * np.where(leads_up, LONGER, SHORTER), LEAST_STEPS)
    return options[chosen], values[chosen], steps


def face_factors(
    log_density: Callable[[NDArray[np.float64]], NDArray[np.float64]], boxes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Lower factors (n, 9, 9) of Gaussians at the top (n, 10), by the curvature along each face and turn.

    A box that is seen from one side knows its near faces and not its far ones, so that place and size hang
    together; faces and turns are taken for independent.
    """
    steps, value = np.tile(FIRST_WIDTHS, (len(boxes), 1)), log_density(boxes[:, None])[:, 0]
    for _ in range(WIDTHS_TRIED):
        probes = steps[:, None] * np.concatenate([np.eye(9), -np.eye(9)])
        values = log_density(reshaped(boxes, probes))
        fall = np.maximum(value[:, None] - 0.5 * (values[:, :9] + values[:, 9:]), LEAST_FALL)
        steps = np.clip(steps / np.sqrt(2 * fall), LEAST_WIDTHS, LARGEST_WIDTHS)
    half_m = np.exp(boxes[:, 7:])
    rotations = Rotation.from_quat(boxes[:, :4], scalar_first=True).as_matrix()
    change = np.zeros((len(boxes), 9, 9))
    for axis in range(3):
        for face, sign in ((2 * axis, 1.0), (2 * axis + 1, -1.0)):
            change[:, :3, face] = 0.5 * sign * rotations[:, :, axis]
            change[:, 6 + axis, face] = 0.5 / half_m[:, axis]
        change[:, 3 + axis, 6 + axis] = 1.0
    wide = change * steps[:, None]
    return np.asarray(np.linalg.cholesky(wide @ np.swapaxes(wide, 1, 2)), np.float64)


def reshaped(solids: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solids (n, S, 10) from solids (n, 10) by moving their faces outwards and turning them.

    Args:
        solids: poses and logs of half sizes.
        steps: (n, S, 9) metres of the faces +x, -x, +y, -y, +z, -z, and turns about the solid's own axes.
    """
    half_m = np.exp(solids[:, None, 7:])
    ahead, back = steps[..., 0:6:2], steps[..., 1:6:2]
    grown = np.maximum(half_m + 0.5 * (ahead + back), THINNER * half_m)
    rotation = Rotation.from_quat(solids[:, :4], scalar_first=True).as_matrix()
    offsets = np.einsum("nij,nsj->nsi", rotation, 0.5 * (ahead - back))
    return moved(solids, np.concatenate([offsets, steps[..., 6:], np.log(grown / half_m)], axis=-1))


def moved(states: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """States (n, S, 7 + D) from states (n, 7 + D) by offsets, turns of the box, and additions."""
    turned = Rotation.from_quat(np.repeat(states[:, :4], steps.shape[1], axis=0), scalar_first=True)
    turned *= Rotation.from_rotvec(steps[..., 3:6].reshape(-1, 3))
    wxyz = turned.as_quat(scalar_first=True).reshape(*steps.shape[:2], 4)
    others = states[:, None, 7:] + steps[..., 6:]
    return np.concatenate([wxyz, states[:, None, 4:7] + steps[..., :3], others], axis=-1)
