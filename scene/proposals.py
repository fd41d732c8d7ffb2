"""Where the chains look: a mixture for every object, of its refined Gaussian and the pool's best poses."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from scene.initialisation import Initialisation
from scene.pose_mixture import PoseMixture
from scene.poses import composed
from scene.refinement import Refinement

OTHERS, OTHERS_SHARE = 7, 0.2
OTHER_SIGMA = np.repeat([0.002, 0.03], 3)
WIDE, WIDE_SHARE = 2.0, 0.2
"""A second, wider Gaussian for the tails."""


def pose_proposals(
    start: Initialisation, refined: Refinement, pixel_weight: float, world_from_camera: jax.Array, bodies: int
) -> PoseMixture:
    """The mixtures of N objects, and places without use for `bodies` - N more, in the world's frame.

    Args:
        start: with the pools.
        refined: Gaussians of the best scene.
        pixel_weight: the likelihood's exponent.
        world_from_camera: (7,).
        bodies: of the scene graph.
    """
    count = len(start.poses)
    gains = start.log_gains[:, : start.pools.shape[1]]
    best = np.argsort(-gains, axis=1)[:, :OTHERS]
    others = np.take_along_axis(start.pools, best[..., None], axis=1)
    log_others = pixel_weight * np.take_along_axis(gains, best, axis=1)
    log_others = log_others - np.logaddexp.reduce(log_others, axis=1, keepdims=True)
    own = np.log([1 - OTHERS_SHARE - WIDE_SHARE, WIDE_SHARE])
    log_weights = np.concatenate([np.tile(own, (count, 1)), np.log(OTHERS_SHARE) + log_others], axis=1)
    narrow = np.tile(np.diag(OTHER_SIGMA**2), (count, OTHERS, 1, 1))
    laplace = refined.covariances[:, None]
    covariances = np.concatenate([laplace, WIDE**2 * laplace, narrow], axis=1)
    centres = np.concatenate([np.repeat(refined.means[:, None], 2, axis=1), others], axis=1)

    def filled(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([values, np.repeat(values[:1], bodies - count, axis=0)])

    return _in_world(world_from_camera, filled(log_weights), filled(centres), filled(covariances))


@jax.jit
def _in_world(
    world_from_camera: jax.Array, log_weights: jax.Array, centres: jax.Array, covariances: jax.Array
) -> PoseMixture:
    """The mixture from poses (C, K, 7) and covariances (C, K, 6, 6) whose offsets are in the camera."""
    turn = jnp.eye(6).at[:3, :3].set(jaxlie.SO3(world_from_camera[:4]).as_matrix())
    centres = jax.vmap(jax.vmap(lambda pose: composed(world_from_camera, pose)))(centres)
    return PoseMixture.build(log_weights, centres, turn @ covariances @ turn.T)
