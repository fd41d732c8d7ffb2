"""Initial proposal mixtures: for each object Gaussians round particles, and the best poses of the search."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from scene.execution import FAST_COMPILE
from scene.mcmc.pose_mixture import PoseMixture, place_of
from scene.mcmc.symmetry_arrays import SpinLines
from scene.search.importance_sampling import distinct
from scene.search.search_result import Initialisation
from shapes.geometry.poses import compose
from shapes.stored_kernels import jit_stored

MODES = 6
"""Of an object, to which proposals are fitted."""

OTHERS, OTHERS_SHARE = 7, 0.15

OTHER_SIGMA = np.repeat([0.002, 0.03], 3)

ATOMS_SHARE, ATOM_RAD = 0.1, 0.08
"""Of atoms from masks, and the standard deviation of a turn that is even over a step of 15 degrees."""

WIDE, WIDE_SHARE = 2.0, 0.25
"""Own components that are wider, for the tails."""

MODE_SIGMA = np.repeat([0.0005, 0.005], 3)
"""Standard deviations before any state has told more: what a recording's pixels tell of a pose."""

SPIN_RAD, WIDE_SPIN_RAD = 0.65, 1.0
"""Standard deviations of the spin of round objects: the components join up to a circle."""


def spin(direction: jax.Array, angle: jax.Array) -> jaxlie.SO3:
    """The turn about a direction (3,) of the box; none where it is 0."""
    half = jnp.where(jnp.any(direction != 0), angle / 2, 0.0)
    return jaxlie.SO3(jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * direction]))


def own_components(
    log_weights: jax.Array, means: jax.Array, covariances: jax.Array, line: SpinLines
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Weights (logs), centres and covariances of one object's components in its modes.

    A Gaussian for each mode, and then a wider one for each. Of an object that is round about a line those of
    the first mode are repeated round the circle, turned with it, in place of the wider ones; and in place of
    the others too where nothing tells the spin.

    Args:
        log_weights: (MODES,), which add up to 1.
        means: (MODES, 7).
        covariances: (MODES, 6, 6), with offsets of the line's point.
        line: about which the object is round, if any.
    """
    log_shares = jnp.log(jnp.array([1 - WIDE_SHARE, WIDE_SHARE], log_weights.dtype))
    log_each = (log_shares[:, None] + log_weights[None]).ravel()
    log_spun = jnp.repeat(log_shares - math.log(MODES), MODES)
    wider = jnp.concatenate([covariances, WIDE**2 * covariances])
    spun, spun_covariances = _round_the_circle(means[0], covariances[0], line)
    circle = jnp.where(jnp.arange(2 * MODES) < MODES, line.free, line.there)
    return (
        jnp.where(circle, log_spun, log_each),
        jnp.where(circle[:, None], spun, jnp.concatenate([means, means])),
        jnp.where(circle[:, None, None], spun_covariances, wider),
    )


def _round_the_circle(mean: jax.Array, covariance: jax.Array, line: SpinLines) -> tuple[jax.Array, jax.Array]:
    """Centres and covariances of a round object's components, the wider ones last."""
    turns = jnp.tile(jnp.arange(MODES) / MODES, 2)
    is_wide = jnp.arange(2 * MODES) >= MODES
    along = jnp.zeros(6).at[3:].set(line.directions)
    across = jnp.eye(6) - jnp.outer(along, along)
    point_m = place_of(line.points_m, mean)

    def component(turn: jax.Array, is_wide: jax.Array) -> tuple[jax.Array, jax.Array]:
        spun = spin(line.directions, 2 * jnp.pi * turn)
        turned = (jaxlie.SO3(mean[:4]) @ spun).normalize()
        centre = jnp.concatenate([turned.wxyz, point_m - turned @ line.points_m])
        sigma = jnp.where(is_wide, WIDE_SPIN_RAD, SPIN_RAD)
        free = across @ (covariance * jnp.where(is_wide, WIDE**2, 1.0)) @ across
        free = free + sigma**2 * jnp.outer(along, along)
        frame = jnp.eye(6).at[3:, 3:].set(spun.inverse().as_matrix())
        return centre, frame @ free @ frame.T

    return jax.vmap(component)(turns, is_wide)


def pose_proposals(
    start: Initialisation,
    particles: NDArray[np.float64],
    world_from_camera: jax.Array,
    lines: SpinLines,
) -> PoseMixture:
    """The mixtures of N objects, and places without use for the other bodies, in the world's frame.

    Args:
        start: with the pools.
        particles: (N, P, 7) world_from_box, the densest first: modes are those that are apart.
        world_from_camera: (7,).
        lines: about which bodies (C,) are round.
    """
    count = len(start.poses)
    gains = start.log_gains[:, : start.pools.shape[1]]
    best = np.argsort(-gains, axis=1)[:, :OTHERS]
    others = np.take_along_axis(start.pools, best[..., None], axis=1)
    log_others = np.take_along_axis(gains, best, axis=1)
    log_others = log_others - np.logaddexp.reduce(log_others, axis=1, keepdims=True)
    means, log_weights = np.zeros((count, MODES, 7)), np.full((count, MODES), -np.inf)
    for one, poses in enumerate(particles):
        modes = distinct(poses)[:MODES]
        means[one], log_weights[one, : len(modes)] = np.resize(modes, (MODES, 7)), -np.log(len(modes))

    def filled(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([values, np.repeat(values[:1], len(lines.free) - count, axis=0)])

    mixture = _in_world(world_from_camera, *map(filled, (log_weights, means, others, log_others)), lines)
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
        mixture.points_m,
    )


@jit_stored(compiler_options=FAST_COMPILE)
def _in_world(
    world_from_camera: jax.Array,
    log_weights: jax.Array,
    means: jax.Array,
    others: jax.Array,
    log_others: jax.Array,
    lines: SpinLines,
) -> PoseMixture:
    """The mixture from modes (C, M), (C, M, 7) in the world and others (C, K), (C, K, 7) in the camera."""
    others = jax.vmap(jax.vmap(lambda pose: compose(world_from_camera, pose)))(others)
    first = jnp.broadcast_to(jnp.diag(jnp.asarray(MODE_SIGMA**2)), (*log_weights.shape, 6, 6))
    log_own, centres, covariances = jax.vmap(own_components)(log_weights, means, first, lines)
    narrow = jnp.broadcast_to(jnp.diag(jnp.asarray(OTHER_SIGMA**2)), (*log_others.shape, 6, 6))
    return PoseMixture.build(
        jnp.concatenate([jnp.log1p(-OTHERS_SHARE) + log_own, jnp.log(OTHERS_SHARE) + log_others], axis=1),
        jnp.concatenate([centres, others], axis=1),
        jnp.concatenate([covariances, narrow], axis=1),
        lines.points_m,
    )
