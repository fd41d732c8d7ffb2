"""Initial proposal mixtures: for each object its refined Gaussians and the best poses of the search."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from scene.execution import FAST_COMPILE
from scene.mcmc.pose_mixture import PoseMixture
from scene.objects.scene_object import SceneObject
from scene.search.importance_sampling import MODES, Refinement
from scene.search.search_result import Initialisation
from shapes.geometry.poses import compose

OTHERS, OTHERS_SHARE = 7, 0.15

OTHER_SIGMA = np.repeat([0.002, 0.03], 3)

ATOMS_SHARE, ATOM_RAD = 0.1, 0.08
"""Of atoms from masks, and the standard deviation of a turn that is even over a step of 15 degrees."""

WIDE, WIDE_SHARE = 2.0, 0.25
"""Own components that are wider, for the tails."""

TRUST = 0.5
"""Exponent of the modes' masses, which are good to some nats only."""

SPIN_RAD, WIDE_SPIN_RAD = 0.65, 1.0
"""Standard deviations of the spin of round objects: the components join up to a circle."""

ROUND = 0.15
"""Largest sine between a normal of a round object and the plane through its axis; for most of its points."""

MOSTLY = 0.95


def round_axis(one: SceneObject) -> int:
    """The box axis about which an object looks the same from all sides, or -1."""
    for axis in range(3):
        around = np.cross(np.eye(3)[axis], one.points_m)
        radius = np.linalg.norm(around, axis=1)
        outside = radius > 0.1 * radius.max()
        sine = np.abs((around * one.normals).sum(axis=1))[outside] / radius[outside]
        if (sine < ROUND).mean() > MOSTLY:
            return axis
    return -1


def spin(axis: jax.Array, angle: jax.Array) -> jaxlie.SO3:
    """The turn about an axis of the box; none for axis -1."""
    half = jnp.where(axis < 0, 0.0, angle / 2)
    vector = jnp.where(jnp.arange(3) == axis, jnp.sin(half), 0.0)
    return jaxlie.SO3(jnp.concatenate([jnp.cos(half)[None], vector]))


def own_components(
    log_weights: jax.Array, means: jax.Array, covariances: jax.Array, axis: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Weights (logs), centres and covariances of one object's components in its modes.

    A Gaussian for each mode, and then a wider one for each. Of a round object, whose spin nothing tells,
    the two of the first mode are repeated round the circle, turned with it.

    Args:
        log_weights: (MODES,), which add up to 1.
        means: (MODES, 7).
        covariances: (MODES, 6, 6).
        axis: about which the object is round, or -1.
    """
    log_shares = jnp.log(jnp.array([1 - WIDE_SHARE, WIDE_SHARE], log_weights.dtype))
    log_each = (log_shares[:, None] + log_weights[None]).ravel()
    log_spun = jnp.repeat(log_shares - math.log(MODES), MODES)
    wider = jnp.concatenate([covariances, WIDE**2 * covariances])
    spun, spun_covariances = _round_the_circle(means[0], covariances[0], axis)
    is_round = axis >= 0
    return (
        jnp.where(is_round, log_spun, log_each),
        jnp.where(is_round, spun, jnp.concatenate([means, means])),
        jnp.where(is_round, spun_covariances, wider),
    )


def _round_the_circle(mean: jax.Array, covariance: jax.Array, axis: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Centres and covariances of a round object's components, the wider ones last."""
    turns = jnp.tile(jnp.arange(MODES) / MODES, 2)
    is_wide = jnp.arange(2 * MODES) >= MODES

    def component(turn: jax.Array, is_wide: jax.Array) -> tuple[jax.Array, jax.Array]:
        turned = spin(axis, 2 * jnp.pi * turn)
        centre = jnp.concatenate([(jaxlie.SO3(mean[:4]) @ turned).normalize().wxyz, mean[4:]])
        sigma = jnp.where(is_wide, WIDE_SPIN_RAD, SPIN_RAD)
        along = jnp.arange(6) == axis + 3
        free = covariance * jnp.where(is_wide, WIDE**2, 1.0)
        free = jnp.where(along[:, None] | along[None], 0.0, free) + jnp.diag(jnp.where(along, sigma**2, 0.0))
        frame = jnp.eye(6).at[3:, 3:].set(turned.inverse().as_matrix())
        return centre, frame @ free @ frame.T

    return jax.vmap(component)(turns, is_wide)


def pose_proposals(
    start: Initialisation,
    refined: Refinement,
    world_from_camera: jax.Array,
    axes: jax.Array,
) -> PoseMixture:
    """The mixtures of N objects, and places without use for the other bodies, in the world's frame.

    Args:
        start: with the pools.
        refined: Gaussians on their modes.
        world_from_camera: (7,).
        axes: (C,) the box axis about which each body is round, or -1.
    """
    count = len(start.poses)
    gains = start.log_gains[:, : start.pools.shape[1]]
    best = np.argsort(-gains, axis=1)[:, :OTHERS]
    others = np.take_along_axis(start.pools, best[..., None], axis=1)
    log_others = np.take_along_axis(gains, best, axis=1)
    log_others = log_others - np.logaddexp.reduce(log_others, axis=1, keepdims=True)

    def filled(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([values, np.repeat(values[:1], len(axes) - count, axis=0)])

    log_weights = TRUST * refined.log_masses
    log_weights = log_weights - np.logaddexp.reduce(log_weights, axis=1, keepdims=True)
    every = (log_weights, refined.means, refined.covariances, others, log_others)
    mixture = _in_world(world_from_camera, *map(filled, every), axes)
    if start.atoms is None:
        return mixture
    atoms = filled(start.atoms.poses), filled(start.atoms.log_weights)
    return with_atoms(mixture, world_from_camera, *atoms, start.atoms.pitch_m / math.sqrt(12), ATOM_RAD)


@jax.jit
def with_atoms(
    mixture: PoseMixture,
    world_from_camera: jax.Array,
    poses: jax.Array,
    log_weights: jax.Array,
    sigma_m: jax.Array | float,
    sigma_rad: jax.Array | float,
) -> PoseMixture:
    """The mixture with components round atoms that have ATOMS_SHARE of the draws.

    An atom without width could be drawn and never be come back to: it is spread over its cell and its step of
    orientation, by Gaussians of their variance.

    Args:
        mixture: of C bodies.
        world_from_camera: (7,).
        poses: (C, A, 7) camera_from_box.
        log_weights: (C, A), normalised over A, or all -inf for a body without atoms.
        sigma_m: of places.
        sigma_rad: of turns.
    """
    centres = jax.vmap(jax.vmap(lambda pose: compose(world_from_camera, pose)))(poses)
    sigma = jnp.concatenate([jnp.full(3, sigma_m), jnp.full(3, sigma_rad)]).astype(centres.dtype)
    factors = jnp.broadcast_to(jnp.diag(sigma), (*log_weights.shape, 6, 6))
    log_share = jnp.log1p(-ATOMS_SHARE) + mixture.log_weights
    return PoseMixture(
        jax.nn.log_softmax(jnp.concatenate([log_share, jnp.log(ATOMS_SHARE) + log_weights], axis=1), axis=-1),
        jnp.concatenate([mixture.centres, centres], axis=1),
        jnp.concatenate([mixture.choleskys, factors], axis=1),
        jnp.concatenate([mixture.whitenings, jnp.broadcast_to(jnp.diag(1 / sigma), factors.shape)], axis=1),
    )


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _in_world(
    world_from_camera: jax.Array,
    log_weights: jax.Array,
    means: jax.Array,
    covariances: jax.Array,
    others: jax.Array,
    log_others: jax.Array,
    axes: jax.Array,
) -> PoseMixture:
    """The mixture from modes (C, M), (C, M, 7), (C, M, 6, 6), offsets in the camera, and others (C, K, 7)."""
    turn = jnp.eye(6).at[:3, :3].set(jaxlie.SO3(world_from_camera[:4]).as_matrix())
    moved = jax.vmap(jax.vmap(lambda pose: compose(world_from_camera, pose)))
    means, others = moved(means), moved(others)
    log_own, centres, covariances = jax.vmap(own_components)(
        log_weights, means, turn @ covariances @ turn.T, axes
    )
    narrow = jnp.broadcast_to(jnp.diag(jnp.asarray(OTHER_SIGMA**2)), (*log_others.shape, 6, 6))
    return PoseMixture.build(
        jnp.concatenate([jnp.log1p(-OTHERS_SHARE) + log_own, jnp.log(OTHERS_SHARE) + log_others], axis=1),
        jnp.concatenate([centres, others], axis=1),
        jnp.concatenate([covariances, narrow], axis=1),
    )
