"""Mixtures of Gaussians on poses, as independence proposals between modes."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from scene.mcmc.random_variates import draw_index
from shapes.geometry import quaternions
from shapes.geometry.rotation_densities import log_gaussian_pose


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseMixture:
    """K components for each of C objects, in the measure Lebesgue x rotations of mass pi^2.

    A component is Gaussian in (offset in the world, rotation vector on the right) about its centre, the
    offset being that of a point of the object's: a point of the line about which it is round stays where it
    is as it spins. For one rotation another point is a shift, so that the measure is the same.

    Attributes:
        log_weights: (C, K), normalised over K; -inf for unused places.
        centres: (C, K, 7) world_from_object.
        choleskys: (C, K, 6, 6) lower factors of the covariances, translation first.
        whitenings: (C, K, 6, 6) their inverses.
        points_m: (C, 3) in the box frames.
    """

    log_weights: jax.Array
    centres: jax.Array
    choleskys: jax.Array
    whitenings: jax.Array
    points_m: jax.Array

    @classmethod
    def build(
        cls,
        log_weights: jax.Array,
        centres: jax.Array,
        covariances: jax.Array,
        points_m: jax.Array | None = None,
    ) -> PoseMixture:
        """Mixtures from weights that need not be normalised and covariances (C, K, 6, 6)."""
        points_m = jnp.zeros_like(centres[:, 0, 4:]) if points_m is None else points_m
        choleskys = jnp.linalg.cholesky(covariances)
        identity = jnp.broadcast_to(jnp.eye(6, dtype=choleskys.dtype), choleskys.shape)
        whitenings = jax.scipy.linalg.solve_triangular(choleskys, identity, lower=True)
        return cls(jax.nn.log_softmax(log_weights, axis=-1), centres, choleskys, whitenings, points_m)

    def of(self, chosen: jax.Array) -> PoseMixture:
        """The mixture (K,), (K, 7), (K, 6, 6) of one object."""
        return jax.tree.map(lambda leaf: leaf[chosen], self)


def sample(uniform: jax.Array, normal: jax.Array, mixture: PoseMixture) -> jax.Array:
    """Pose (7,) from one object's mixture, of one uniform number and normal ones (6,)."""
    component = draw_index(jnp.exp(mixture.log_weights), uniform)
    tangent = jnp.sum(mixture.choleskys[component] * normal[None], axis=1)
    centre = mixture.centres[component]
    turned = quaternions.normalise(quaternions.multiply(centre[:4], quaternions.exp(tangent[3:])))
    point_m = place_of(mixture.points_m, centre) + tangent[:3]
    return jnp.concatenate([turned, point_m - quaternions.rotate(turned, mixture.points_m)])


def log_density(mixture: PoseMixture, pose: jax.Array) -> jax.Array:
    """Log density of one object's mixture at a pose (7,), summed over all components."""
    there_m = place_of(mixture.points_m, pose)

    def component(centre: jax.Array, whitening: jax.Array) -> jax.Array:
        relative = quaternions.multiply(quaternions.inverse(centre[:4]), pose[:4])
        return log_gaussian_pose(whitening, there_m - place_of(mixture.points_m, centre), relative)

    log_components = jax.vmap(component)(mixture.centres, mixture.whitenings)
    return jax.scipy.special.logsumexp(mixture.log_weights + log_components)


def place_of(point_m: jax.Array, pose: jax.Array) -> jax.Array:
    """Where a point (3,) of an object is at a pose (7,)."""
    return pose[4:] + quaternions.rotate(pose[:4], point_m)
