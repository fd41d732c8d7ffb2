"""Gaussians fitted by adaptive importance sampling (population Monte Carlo, Cappe et al. 2004)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scene.search.importance_sampling import WIDER, tempered

STEP_M, STEP_RAD, FACE_M, LAST_STEP = 0.006, 0.06, 0.03, 0.1
"""First standard deviations of steps of a solid and of its faces, and the share that is left at last."""


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
    rng: np.random.Generator,
    log_density: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    solids: NDArray[np.float64],
    turns: int,
    draws: int,
) -> NDArray[np.float64]:
    """The densest solids (n, 10), poses and logs of half sizes, that are met on the way up.

    Half of the draws move one face, the others the whole; steps become smaller. The best one of a turn is the
    centre of the next.
    """
    count, sigmas = len(solids), np.repeat([STEP_M, STEP_RAD, 0.0], 3)
    for scale in np.geomspace(1.0, LAST_STEP, turns):
        steps = scale * sigmas * rng.standard_normal((count, draws, 9))
        axes, side = rng.integers(3, size=(count, draws)), rng.choice([-1.0, 1.0], (count, draws))
        grow_m = scale * FACE_M * rng.standard_normal((count, draws))
        faces = np.arange(draws) < draws // 2
        outwards = Rotation.from_quat(solids[:, :4], scalar_first=True).as_matrix()
        along = np.take_along_axis(outwards.swapaxes(1, 2), axes[..., None], axis=1)
        steps[:, faces] = 0.0
        steps[..., :3] += np.where(faces[:, None], 0.5 * (side * grow_m)[..., None] * along, 0.0)
        half_m = np.take_along_axis(np.exp(solids[:, 7:]), axes, axis=1)
        grown = np.log(np.maximum(half_m + 0.5 * grow_m, 0.2 * half_m) / half_m)
        np.put_along_axis(steps[..., 6:], axes[..., None], (grown * faces)[..., None], axis=2)
        steps[:, 0] = 0.0
        options = moved(solids, steps)
        best = log_density(options).argmax(axis=1)
        solids = options[np.arange(count), best]
    return solids


def moved(states: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """States (n, S, 7 + D) from states (n, 7 + D) by offsets, turns of the box, and additions."""
    turned = Rotation.from_quat(np.repeat(states[:, :4], steps.shape[1], axis=0), scalar_first=True)
    turned *= Rotation.from_rotvec(steps[..., 3:6].reshape(-1, 3))
    wxyz = turned.as_quat(scalar_first=True).reshape(*steps.shape[:2], 4)
    others = states[:, None, 7:] + steps[..., 6:]
    return np.concatenate([wxyz, states[:, None, 4:7] + steps[..., :3], others], axis=-1)
