"""Where objects may be born that no chain has looked at: Gaussians round poses that the search rejected."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scene.mcmc.mixture_init import of_points, own_components
from scene.mcmc.pose_mixture import PoseMixture
from scene.mcmc.symmetry_arrays import SpinLines
from scene.presence.depth_candidates import PosePriors, PresenceFrames
from scene.search.importance_sampling import FIRST_SIGMA, LEAST_SIGMA, MODES, WIDER, apart, tempered
from scene.search.search_result import Initialisation

SITES = 3
"""Of an object: where the search would put it, where it explains most alone, and the next such place."""

LEAST_DENSITY = 1e-30
"""Of the prior where it excludes a pose: what is fitted may still come to where it does not."""

DRAWS, ALIVE, TURNS = 32, 10.0, 3
"""A site and turn; a third of what refinement takes, whose Gaussians start chains."""


def sites_of(start: Initialisation, one: int) -> NDArray[np.float64]:
    """Poses (SITES, 7) camera_from_box where an object may be that was not found."""
    pool = start.pools[one]
    ranked = pool[np.argsort(-start.log_alone[one, : len(pool)], kind="stable")]
    sites = start.rivals[one][None]
    for pose in ranked:
        if len(sites) == SITES:
            break
        if apart(pose, sites, 1.0).all():
            sites = np.append(sites, pose[None], axis=0)
    return np.resize(sites, (SITES, 7))


def born_near(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    slots: NDArray[np.integer],
    sites: NDArray[np.float64],
    lines: SpinLines,
) -> PoseMixture:
    """Mixtures of slots (R,) round sites (R, SITES, 7) world_from_box.

    Gaussians are fitted to what the object explains there alone, by importance sampling in some turns.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of poses.
        slots: numbers of the objects.
        sites: where they may be.
        lines: about which they (R,) are round.
    """
    owners = np.repeat(slots, SITES)
    centres = sites.reshape(-1, 7)
    factors = np.tile(np.diag(FIRST_SIGMA), (len(owners), 1, 1))
    for _ in range(TURNS):
        normal = rng.standard_normal((len(owners), DRAWS, 6))
        normal[:, 0] = 0.0
        tangents = np.einsum("nij,nsj->nsi", factors, normal)
        poses = _moved(centres, tangents)
        _, gain = frames.shown(rng, np.repeat(owners, DRAWS), poses.reshape(-1, 7))
        log_alone = gain.sum(axis=1, dtype=np.float64).reshape(-1, DRAWS)
        log_alone += np.log(np.maximum(priors.alone(owners, poses), LEAST_DENSITY))
        log_weights = log_alone + 0.5 * (normal**2).sum(axis=-1)
        weights = np.stack([tempered(one, ALIVE) for one in log_weights])
        steps = np.einsum("ns,nsi->ni", weights, tangents)
        spread = tangents - steps[:, None]
        covariances = np.einsum("ns,nsi,nsj->nij", weights, spread, spread) + np.diag(LEAST_SIGMA**2)
        centres = _moved(centres, steps[:, None])[:, 0]
        factors = WIDER * np.linalg.cholesky(covariances)
    return _mixture(centres, factors, lines)


def _mixture(centres: NDArray[np.float64], factors: NDArray[np.float64], lines: SpinLines) -> PoseMixture:
    """Mixtures of objects with SITES Gaussians each, of round ones spun round the circle."""
    count = len(centres) // SITES
    even = np.full((len(centres), MODES), -np.log(MODES))
    means, covariances = (
        np.repeat(part[:, None], MODES, axis=1) for part in (centres, factors @ np.swapaxes(factors, 1, 2))
    )
    with jax.enable_x64(True):
        each = jax.tree.map(lambda leaf: jnp.repeat(leaf, SITES, axis=0), lines)
        about = jax.vmap(of_points)(jnp.asarray(covariances), jnp.asarray(means), each.points_m)
        parts = jax.vmap(own_components)(jnp.asarray(even), jnp.asarray(means), about, each)
        log_weights, means, about = (leaf.reshape(count, -1, *leaf.shape[2:]) for leaf in parts)
        return PoseMixture.build(log_weights, means, about, lines.points_m)


def _moved(poses: NDArray[np.float64], steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (n, S, 7) from poses (n, 7) by offsets in the world and turns of the box (n, S, 6)."""
    turned = Rotation.from_quat(np.repeat(poses[:, :4], steps.shape[1], axis=0), scalar_first=True)
    turned *= Rotation.from_rotvec(steps[..., 3:].reshape(-1, 3))
    wxyz = turned.as_quat(scalar_first=True).reshape(*steps.shape[:2], 4)
    return np.concatenate([wxyz, poses[:, None, 4:] + steps[..., :3]], axis=-1)
