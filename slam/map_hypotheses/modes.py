"""Several maps of the same keyframes with their probabilities, and particles assigned to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from shapes.geometry.pose_sets import MAX_CLUSTERS, within_reach
from shapes.resampling import resample_systematically

LEAST_SHARE = 0.01
"""Less than one particle of 64 stands for it."""


@dataclass(frozen=True)
class Modes:
    """Maps that are left.

    Attributes:
        maps: (G, N, 4, 4) reference_from_keyframe, the likeliest first.
        shares: (G,) their probabilities.
    """

    maps: NDArray[np.float64]
    shares: NDArray[np.float64]

    @classmethod
    def of(cls, maps: Sequence[NDArray[np.float64]], log_weights: Sequence[float]) -> Modes:
        """Those of distinct maps (N, 4, 4) that are not negligible; of maps that are alike the likeliest."""
        kept: list[int] = []
        for index in np.argsort(-np.asarray(log_weights), kind="stable").tolist():
            if not any(within_reach(maps[index], maps[other]).all() for other in kept):
                kept.append(index)
        weights = np.asarray(log_weights, np.float64)[kept]
        shares = np.exp(weights - np.logaddexp.reduce(weights))
        enough = (shares >= LEAST_SHARE) & (np.arange(len(kept)) < MAX_CLUSTERS)
        return cls(np.stack(maps)[kept][enough], shares[enough] / shares[enough].sum())


def assign_modes(
    key: jax.Array, shares: NDArray[np.float64], log_weights: NDArray[np.float64]
) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
    """Which mode each particle stands for (K,) from now on, and its log weight (K,).

    Systematic: a mode of share s gets K s particles to within one, in an order that tells nothing, and among
    them the weight s, divided as their own weights say.

    Args:
        key: consumed.
        shares: (G,) of the modes, normalised.
        log_weights: (K,) normalised.
    """
    deal_key, order_key = jax.random.split(key)
    count = len(log_weights)
    room = jnp.full(count, -jnp.inf).at[: len(shares)].set(jnp.log(jnp.asarray(shares[:count], jnp.float32)))
    order = np.asarray(jax.random.permutation(order_key, count))
    modes = np.asarray(resample_systematically(deal_key, room), int)[order]
    weights = np.array(log_weights, np.float64)
    for mode in np.unique(modes):
        members = modes == mode
        weights[members] += np.log(shares[mode]) - np.logaddexp.reduce(weights[members])
    return modes, weights - np.logaddexp.reduce(weights)


@jax.jit
def transport(poses: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
    """Poses (K, N, 7) that keep their displacements when their means (K, N, 7) move."""

    def one(pose: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
        return (jaxlie.SE3(after) @ jaxlie.SE3(before).inverse() @ jaxlie.SE3(pose)).wxyz_xyz

    return jax.vmap(jax.vmap(one))(poses, before, after)
