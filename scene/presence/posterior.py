"""What the images say of which objects are there: moves among candidates that are drawn anew between them.

Where chains have been, candidates are drawn from what they learned of an object's pose; elsewhere from
Gaussians round the places that the search had for it. Every chain has candidates of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.execution import FAST_COMPILE
from scene.hidden.hidden_places import HiddenPlaces
from scene.mcmc import pose_mixture
from scene.mcmc.pose_mixture import PoseMixture
from scene.presence.depth_candidates import PresenceFrames, candidates_of
from scene.presence.pose_priors import PosePriors
from scene.presence.solids import SolidFits
from scene.presence.toggling import ABSENT, Candidates, toggle

CANDIDATES = 24
"""K of a slot: of draws from a fitted Gaussian in six dimensions a third or so then counts."""

DRAWN, SWEEPS = 2, 12
"""How often candidates are drawn in a chain, and sweeps with each."""

BURN_IN = 4
"""Sweeps that are dropped: what is there may first take another's place."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Presence:
    """Which of N objects are there.

    Attributes:
        probability: (N,).
        standard_error: (N,) of it, from how chains differ, and from the draws of hidden poses.
    """

    probability: NDArray[np.float64]
    standard_error: NDArray[np.float64]


DrawCandidates = Callable[[NDArray[np.float64], NDArray[np.bool_]], tuple[NDArray[np.float64], Candidates]]
"""Poses (N, K, 7), of which the first is a given one (N, 7) where that is kept (N,), and what they show."""


def chain_presence(
    rng: np.random.Generator,
    draw: DrawCandidates,
    poses: NDArray[np.float64],
    drawings: int = DRAWN,
    sweeps: int = SWEEPS,
) -> NDArray[np.float64]:
    """Presence (N, 2) by a chain from the empty scene, all and hidden.

    Args:
        rng: random numbers.
        draw: draws candidates anew.
        poses: (N, ...) of what is not there, any.
        drawings: of candidates.
        sweeps: with each.
    """
    choice, sums = np.full(len(poses), ABSENT), np.zeros((len(poses), 3))
    for drawing in range(drawings):
        drawn, candidates = draw(poses, choice >= 0)
        choice = np.where(choice >= 0, 0, choice)
        if drawing == 0:
            choice, _ = toggle(rng, candidates, choice, BURN_IN)
        choice, expected = toggle(rng, candidates, choice, sweeps)
        poses = drawn[np.arange(len(poses)), np.maximum(choice, 0)]
        sums += expected
    return sums[:, :2] / sums[:, 2:]


def presence_posterior(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    mixture: PoseMixture,
    solids: SolidFits,
    chains: int,
    hidden: HiddenPlaces,
) -> Presence:
    """Presence of N objects by chains that start with the empty scene.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of sets and poses.
        mixture: of the objects, from which candidates are drawn.
        solids: unknown things that may be there in their place.
        chains: how many.
        hidden: what objects that were not found do to the likelihood out of sight.
    """
    with np.errstate(divide="ignore"):
        log_hidden = np.log(hidden.share)
    objects, beside = len(priors.half_m), len(solids.is_round)
    log_half = np.log(priors.half_m)
    sizes = np.tile(log_half[:, None], (1, CANDIDATES, 1))

    def draw(states: NDArray[np.float64], kept: NDArray[np.bool_]) -> tuple[NDArray[np.float64], Candidates]:
        poses, log_poses = _drawn(mixture, rng, states[:objects, :7], kept[:objects])
        others = solids.drawn(rng, CANDIDATES)
        others[kept[objects:], 0] = states[objects:][kept[objects:]]
        drawn = np.concatenate([np.concatenate([poses, sizes], axis=-1), others])
        log_offered = np.concatenate([log_poses, solids.log_density(others)])
        return drawn, candidates_of(rng, frames, priors, drawn, solids.is_round, log_offered, log_hidden)

    nowhere = np.tile([1.0, *[0.0] * 9], (objects + beside, 1))
    by_chain = [chain_presence(rng, draw, nowhere)[:objects] for _ in range(chains)]
    there, unseen = np.moveaxis(np.stack(by_chain), 2, 0)
    told = there.mean(axis=0)
    of_share = (
        unseen.mean(axis=0) * (1 - told) * hidden.share_std / np.where(hidden.share > 0, hidden.share, 1)
    )
    of_chains = there.std(axis=0, ddof=1) / np.sqrt(chains)
    return Presence(probability=told, standard_error=np.hypot(of_chains, of_share))


def _drawn(
    mixture: PoseMixture, rng: np.random.Generator, poses: NDArray[np.float64], kept: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Candidates (N, K, 7) and their log densities (N, K); the first is a pose (N, 7) where that is kept."""
    shape = len(kept), CANDIDATES
    uniform, normal = rng.random(shape), rng.standard_normal((*shape, 6))
    with jax.enable_x64(True):
        drawn, log_offered = _sampled(mixture, uniform, normal, poses, kept)
    return np.asarray(drawn), np.asarray(log_offered)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _sampled(
    mixture: PoseMixture, uniform: jax.Array, normal: jax.Array, poses: jax.Array, kept: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The same of numbers (N, K) and (N, K, 6)."""

    def of_slot(
        mixture: PoseMixture, uniform: jax.Array, normal: jax.Array, pose: jax.Array, keep: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        drawn = jax.vmap(lambda one, other: pose_mixture.sample(one, other, mixture))(uniform, normal)
        drawn = drawn.at[0].set(jnp.where(keep, pose, drawn[0]))
        return drawn, jax.vmap(partial(pose_mixture.log_density, mixture))(drawn)

    return jax.vmap(of_slot)(mixture, uniform, normal, poses, kept)
