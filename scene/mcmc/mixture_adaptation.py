"""Adaptation of the proposal mixtures to the first part of the chains, which is then dropped.

Once samples are kept the proposals stay as they are, so that the chains are exact (Roberts and Rosenthal
2009, Examples of Adaptive MCMC: adaptation that ends).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie

from scene.execution import FAST_COMPILE
from scene.mcmc.mixture_init import MODES, own_components, spin
from scene.mcmc.pose_mixture import PoseMixture, place_of
from scene.mcmc.symmetry_arrays import SpinLines
from shapes.stored_kernels import jit_stored

NEAR_M, NEAR_RAD = 0.005, 0.35
"""What counts as one unit of distance from a mode; a state belongs to the nearest."""

FURTHEST = 4.0
"""States that are further from every mode teach nothing."""

LEAST_M, LEAST_RAD = 0.00005, 0.0005

FEW = 4.0
"""States that say as much of a covariance as is known without: by all modes together, and before."""

KEPT_SHARE = 0.1
"""Of the old weights: a mode that was not visited may yet be."""

MEAN_STEPS = 3


@jit_stored(compiler_options=FAST_COMPILE)
def adapt_mixture(mixture: PoseMixture, lines: SpinLines, poses: jax.Array) -> PoseMixture:
    """The mixtures with components of their own fitted to states (S, C, 7), each in its mode.

    A chain that changes to another mode comes back only where proposals know both.

    Args:
        mixture: from `pose_proposals`.
        lines: about which objects (C,) are round.
        poses: (S, C, 7).
    """
    log_weights, centres, covariances = jax.vmap(_own, in_axes=(0, 0, 1))(mixture, lines, poses)
    own = PoseMixture.build(log_weights, centres, covariances, mixture.points_m)
    used = log_weights.shape[1]
    log_share = jax.scipy.special.logsumexp(mixture.log_weights[:, :used], axis=1, keepdims=True)
    own = replace(own, log_weights=log_share + own.log_weights)
    return jax.tree.map(lambda every, first: every.at[:, : first.shape[1]].set(first), mixture, own)


def modes_of(log_weights: jax.Array, line: SpinLines) -> jax.Array:
    """Weights (MODES,) of one object's modes in its mixture (K,), their sum 1; what spins has the first."""
    is_mode = ~line.free | (jnp.arange(MODES) == 0)
    return jax.nn.softmax(jnp.where(is_mode, log_weights[:MODES], -jnp.inf))


def _own(mixture: PoseMixture, line: SpinLines, poses: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """One object's own components, as `own_components` has them, of states (S, 7)."""
    weights, modes = modes_of(mixture.log_weights, line), mixture.centres[:MODES]
    steps = jax.vmap(partial(_steps, poses=poses, line=line))(modes)
    unit = jnp.repeat(jnp.array([NEAR_M, NEAR_RAD], poses.dtype), 3)
    distance = jnp.linalg.norm(steps / unit[None, None], axis=2)
    distance = jnp.where(weights[:, None] > 0, distance, jnp.inf)
    nearest = jnp.arange(MODES)[:, None] == jnp.argmin(distance, axis=0)[None]
    mine = (nearest & (distance < FURTHEST)).astype(poses.dtype)
    counts = jnp.sum(mine, axis=1)

    centres, scatters = jax.vmap(partial(_moments, poses=poses, line=line))(modes, mine)
    old = jax.vmap(_in_world)(
        modes, mixture.choleskys[:MODES] @ jnp.swapaxes(mixture.choleskys[:MODES], 1, 2)
    )
    together = (jnp.sum(scatters, axis=0) + FEW * old[0]) / (jnp.sum(counts) + FEW)
    covariances = (scatters + FEW * together[None]) / (counts + FEW)[:, None, None]
    least = jnp.diag(jnp.repeat(jnp.array([LEAST_M, LEAST_RAD], poses.dtype) ** 2, 3))
    covariances = jax.vmap(_in_box)(centres, covariances + least[None])
    seen = counts / jnp.maximum(jnp.sum(counts), 1.0)
    log_weights = jnp.log((1 - KEPT_SHARE) * seen + KEPT_SHARE * weights)
    return own_components(log_weights, centres, covariances, line)


def _moments(
    mode: jax.Array, mine: jax.Array, poses: jax.Array, line: SpinLines
) -> tuple[jax.Array, jax.Array]:
    """Mean (7,) of the states (S, 7) that belong to a mode, and their scatter (6, 6) in the world."""
    weights = mine / jnp.maximum(jnp.sum(mine), 1.0)
    mean = mode
    for _ in range(MEAN_STEPS):
        step = weights @ _steps(mean, poses, line)
        turned = (jaxlie.SO3(mean[:4]) @ jaxlie.SO3.exp(step[3:])).normalize()
        point_m = place_of(line.points_m, mean) + step[:3]
        mean = jnp.concatenate([turned.wxyz, point_m - turned @ line.points_m])
    steps = _steps(mean, poses, line)
    return mean, _in_world(mean, (mine[:, None] * steps).T @ steps)


def _in_world(pose: jax.Array, covariance: jax.Array) -> jax.Array:
    """A covariance (6, 6) with turns along the world's axes, of one with turns along the box's."""
    frame = jnp.eye(6).at[3:, 3:].set(jaxlie.SO3(pose[:4]).as_matrix())
    return frame @ covariance @ frame.T


def _in_box(pose: jax.Array, covariance: jax.Array) -> jax.Array:
    """The inverse."""
    return _in_world(jnp.concatenate([jaxlie.SO3(pose[:4]).inverse().wxyz, pose[4:]]), covariance)


def _steps(start: jax.Array, poses: jax.Array, line: SpinLines) -> jax.Array:
    """Offsets of the line's point in the world and rotation vectors on the right (S, 6), from a pose (7,).

    Where the object spins freely, its spin is left out (swing-twist decomposition).
    """

    def step(end: jax.Array) -> jax.Array:
        turn = jaxlie.SO3(start[:4]).inverse() @ jaxlie.SO3(end[:4])
        angle = 2 * jnp.arctan2(turn.wxyz[1:] @ line.directions, turn.wxyz[0])
        swing = turn @ spin(line.directions, -angle)
        offset_m = place_of(line.points_m, end) - place_of(line.points_m, start)
        return jnp.concatenate([offset_m, jnp.where(line.free, swing.log(), turn.log())])

    return jax.vmap(step)(poses)
