"""Proposals learned from the first part of the chains, which is then dropped.

Once samples are kept the proposals stay as they are, so that the chains are exact (Roberts and Rosenthal
2009, Examples of Adaptive MCMC: adaptation that ends).
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie

from scene.pose_mixture import PoseMixture
from scene.proposals import WIDE

NEAR_M, NEAR_RAD = 0.02, 1.5
"""States further from the best one than this belong to another mode."""
LEAST_M, LEAST_RAD = 0.00005, 0.0005
MEAN_STEPS = 3


@jax.jit
def adapted(mixture: PoseMixture, poses: jax.Array, log_posteriors: jax.Array) -> PoseMixture:
    """The mixtures with Gaussians fitted to states (S, C, 7) in place of the first two components."""
    best = poses[jnp.argmax(log_posteriors)]
    centres, covariances = jax.vmap(_moments, in_axes=(1, 0))(poses, best)
    fitted = PoseMixture.build(
        mixture.log_weights[:, :2],
        jnp.repeat(centres[:, None], 2, axis=1),
        jnp.stack([covariances, WIDE**2 * covariances], axis=1),
    )
    return replace(
        mixture,
        centres=mixture.centres.at[:, :2].set(fitted.centres),
        choleskys=mixture.choleskys.at[:, :2].set(fitted.choleskys),
        whitenings=mixture.whitenings.at[:, :2].set(fitted.whitenings),
    )


def _moments(poses: jax.Array, best: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean (7,) and covariance (6, 6), in the mixture's chart, of the states (S, 7) in the mode of `best`."""
    offsets, turns = jax.vmap(lambda pose: _step(best, pose))(poses)
    near = (jnp.linalg.norm(offsets, axis=1) < NEAR_M) & (jnp.linalg.norm(turns, axis=1) < NEAR_RAD)
    weights = near / jnp.sum(near)
    mean = best
    for _ in range(MEAN_STEPS):
        offsets, turns = jax.vmap(lambda pose, mean=mean: _step(mean, pose))(poses)
        turned = jaxlie.SO3(mean[:4]) @ jaxlie.SO3.exp(weights @ turns)
        mean = jnp.concatenate([turned.normalize().wxyz, mean[4:] + weights @ offsets])
    offsets, turns = jax.vmap(lambda pose: _step(mean, pose))(poses)
    tangents = jnp.concatenate([offsets, turns], axis=1)
    least = jnp.repeat(jnp.array([LEAST_M, LEAST_RAD], poses.dtype) ** 2, 3)
    return mean, (weights[:, None] * tangents).T @ tangents + jnp.diag(least)


def _step(start: jax.Array, end: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Offset (3,) in the world and rotation vector (3,) on the right from one pose (7,) to another."""
    return end[4:] - start[4:], (jaxlie.SO3(start[:4]).inverse() @ jaxlie.SO3(end[:4])).log()
