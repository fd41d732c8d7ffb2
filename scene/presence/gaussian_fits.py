"""Gaussians fitted by adaptive importance sampling (population Monte Carlo, Cappe et al. 2004)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scene.search.importance_sampling import WIDER, tempered

FACE_M, TURN_RAD = (0.02, 0.0005), (0.06, 0.002)
"""First and least steps of a solid's faces and of its turns, ..."""
LONGER, SHORTER, FURTHEST = 1.3, 0.5, 2.0
"""... which grow where they lead up and shrink where they do not; most steps to the top of a parabola."""
FLATTEST, THINNER = 1e-9, 0.2
"""Least curvature, and least share of a half size that a step leaves."""


def fitted(
    rng: np.random.Generator,
    log_density: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    centres: NDArray[np.float64],
    factors: NDArray[np.float64],
    least: NDArray[np.float64],
    turns: int,
    draws: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centres (n, 7 + D) and lower factors (n, 6 + D, 6 + D) of the Gaussians, all fitted side by side.

    Args:
        rng: random numbers.
        log_density: of states (n, S, 7 + D), (n, S).
        centres: first ones: poses, then D other numbers.
        factors: first ones, of offsets in the world, turns of the box, the other numbers.
        least: (6 + D,) standard deviations that are added.
        turns: of fitting.
        draws: S, of a Gaussian in each; a third of them stay alive when weights are tempered.
    """
    for _ in range(turns):
        normal = rng.standard_normal((len(centres), draws, factors.shape[1]))
        normal[:, 0] = 0.0
        steps = np.einsum("nij,nsj->nsi", factors, normal)
        log_weights = log_density(moved(centres, steps)) + 0.5 * (normal**2).sum(axis=-1)
        weights = np.stack([tempered(one, draws / 3) for one in log_weights])
        means = np.einsum("ns,nsi->ni", weights, steps)
        spread = steps - means[:, None]
        covariances = np.einsum("ns,nsi,nsj->nij", weights, spread, spread) + np.diag(least**2)
        centres = moved(centres, means[:, None])[:, 0]
        factors = WIDER * np.linalg.cholesky(covariances)
    return centres, factors


def climbed(
    log_density: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    solids: NDArray[np.float64],
    turns: int,
) -> NDArray[np.float64]:
    """The densest solids (n, 10), poses and logs of half sizes, that are met on the way up.

    A pattern search (Hooke and Jeeves 1961): each turn every face and every turn is moved either way; what
    leads up is then tried together, as far as the parabolas through three points say.
    """
    steps = np.tile(np.repeat([FACE_M[0], TURN_RAD[0]], [6, 3]), (len(solids), 1))
    least = np.repeat([FACE_M[1], TURN_RAD[1]], [6, 3])
    best, value = solids, log_density(solids[:, None])[:, 0]
    for _ in range(turns):
        probes = steps[:, None] * np.concatenate([np.eye(9), -np.eye(9)])
        options = reshaped(best, probes)
        values = log_density(options)
        up, down = values[:, :9], values[:, 9:]
        leads_up = np.maximum(up, down) > value[:, None]
        towards = np.where(leads_up, np.sign(up - down), 0.0)
        curvature = np.minimum(up + down - 2 * value[:, None], 0.0)
        tops = np.clip((up - down) / 2 / np.maximum(-curvature, FLATTEST), -FURTHEST, FURTHEST)
        tops = np.where(curvature < 0, tops, FURTHEST * towards)
        together = np.stack([tops, 0.5 * tops, towards, 0.5 * towards, tops * leads_up], axis=1)
        combined = reshaped(best, together * steps[:, None])
        options = np.concatenate([best[:, None], options, combined], axis=1)
        values = np.concatenate([value[:, None], values, log_density(combined)], axis=1)
        chosen = np.arange(len(solids)), values.argmax(axis=1)
        best, value = options[chosen], values[chosen]
        steps = np.clip(steps * np.where(leads_up, LONGER, SHORTER), least, np.inf)
    return best


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
