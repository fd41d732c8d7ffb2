"""Proposals learned from the first part of the chains, which is then dropped.

Once samples are kept the proposals stay as they are, so that the chains are exact (Roberts and Rosenthal
2009, Examples of Adaptive MCMC: adaptation that ends).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie

from scene.ahead import SELDOM
from scene.pose_mixture import PoseMixture
from scene.proposals import own_components, spin

NEAR_M, NEAR_RAD = 0.02, 1.0
"""States further from the best one than this belong to another mode."""
LEAST_M, LEAST_RAD = 0.00005, 0.0005
MEAN_STEPS = 3


@partial(jax.jit, compiler_options=SELDOM)
def adapted(
    mixture: PoseMixture, axes: jax.Array, poses: jax.Array, log_posteriors: jax.Array
) -> PoseMixture:
    """The mixtures with components of their own fitted to states (S, C, 7).

    Args:
        mixture: from `pose_proposals`.
        axes: (C,) the box axis about which each object is round, or -1.
        poses: (S, C, 7).
        log_posteriors: (S,).
    """
    best = poses[jnp.argmax(log_posteriors)]
    centres, covariances = jax.vmap(_moments, in_axes=(1, 0, 0))(poses, best, axes)
    log_weights, centres, covariances = jax.vmap(own_components)(centres, covariances, axes)
    own = PoseMixture.build(log_weights, centres, covariances)
    return replace(
        mixture,
        centres=_replaced(mixture.centres, own.centres),
        choleskys=_replaced(mixture.choleskys, own.choleskys),
        whitenings=_replaced(mixture.whitenings, own.whitenings),
    )


def _replaced(values: jax.Array, own: jax.Array) -> jax.Array:
    return values.at[:, : own.shape[1]].set(own)


def _moments(poses: jax.Array, best: jax.Array, axis: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean (7,) and covariance (6, 6), in the mixture's chart, of the states (S, 7) in the mode of `best`."""
    offsets, turns = jax.vmap(lambda pose: _step(best, pose, axis))(poses)
    near = (jnp.linalg.norm(offsets, axis=1) < NEAR_M) & (jnp.linalg.norm(turns, axis=1) < NEAR_RAD)
    weights = near / jnp.sum(near)
    mean = best
    for _ in range(MEAN_STEPS):
        offsets, turns = jax.vmap(lambda pose, mean=mean: _step(mean, pose, axis))(poses)
        turned = jaxlie.SO3(mean[:4]) @ jaxlie.SO3.exp(weights @ turns)
        mean = jnp.concatenate([turned.normalize().wxyz, mean[4:] + weights @ offsets])
    offsets, turns = jax.vmap(lambda pose: _step(mean, pose, axis))(poses)
    tangents = jnp.concatenate([offsets, turns], axis=1)
    least = jnp.repeat(jnp.array([LEAST_M, LEAST_RAD], poses.dtype) ** 2, 3)
    return mean, (weights[:, None] * tangents).T @ tangents + jnp.diag(least)


def _step(start: jax.Array, end: jax.Array, axis: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Offset (3,) in the world and rotation vector (3,) on the right from one pose (7,) to another.

    Where the object is round, its spin is left out (swing-twist decomposition).
    """
    turn = jaxlie.SO3(start[:4]).inverse() @ jaxlie.SO3(end[:4])
    angle = 2 * jnp.arctan2(turn.wxyz[1 + jnp.maximum(axis, 0)], turn.wxyz[0])
    swing = turn @ spin(axis, -angle)
    return end[4:] - start[4:], jnp.where(axis < 0, turn.log(), swing.log())
