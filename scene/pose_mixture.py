"""Mixtures of Gaussians on poses, as proposals: they see the other modes that a walk cannot reach."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jaxlie

from scene.rotation_densities import log_gaussian_pose


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseMixture:
    """K components for each of C objects, in the measure Lebesgue x rotations of mass pi^2.

    A component is Gaussian in (offset in the world, rotation vector on the right) about its centre.

    Attributes:
        log_weights: (C, K), normalised over K; -inf for unused places.
        centres: (C, K, 7) world_from_object.
        choleskys: (C, K, 6, 6) lower factors of the covariances, translation first.
        whitenings: (C, K, 6, 6) their inverses.
    """

    log_weights: jax.Array
    centres: jax.Array
    choleskys: jax.Array
    whitenings: jax.Array

    @classmethod
    def build(cls, log_weights: jax.Array, centres: jax.Array, covariances: jax.Array) -> PoseMixture:
        """Mixtures from weights that need not be normalised and covariances (C, K, 6, 6)."""
        choleskys = jnp.linalg.cholesky(covariances)
        identity = jnp.broadcast_to(jnp.eye(6, dtype=choleskys.dtype), choleskys.shape)
        whitenings = jax.scipy.linalg.solve_triangular(choleskys, identity, lower=True)
        return cls(jax.nn.log_softmax(log_weights, axis=-1), centres, choleskys, whitenings)

    def of(self, chosen: jax.Array) -> PoseMixture:
        """The mixture (K,), (K, 7), (K, 6, 6) of one object."""
        return jax.tree.map(lambda leaf: leaf[chosen], self)


def sample(key: jax.Array, mixture: PoseMixture) -> jax.Array:
    """Pose (7,) from one object's mixture."""
    component_key, tangent_key = jax.random.split(key)
    cumulative = jnp.cumsum(jnp.exp(mixture.log_weights))
    component = jnp.sum(
        cumulative <= jax.random.uniform(component_key, dtype=cumulative.dtype) * cumulative[-1]
    )
    normal = jax.random.normal(tangent_key, (6,), mixture.choleskys.dtype)
    tangent = jnp.sum(mixture.choleskys[component] * normal[None], axis=1)
    centre = jaxlie.SE3(mixture.centres[component])
    rotation = centre.rotation() @ jaxlie.SO3.exp(tangent[3:])
    position = centre.translation() + tangent[:3]
    return jaxlie.SE3.from_rotation_and_translation(rotation, position).wxyz_xyz


def log_density(mixture: PoseMixture, pose: jax.Array) -> jax.Array:
    """Log density of one object's mixture at a pose (7,), summed over all components."""

    def component(centre: jax.Array, whitening: jax.Array) -> jax.Array:
        relative = jaxlie.SO3(centre[:4]).inverse() @ jaxlie.SO3(pose[:4])
        return log_gaussian_pose(whitening, pose[4:] - centre[4:], relative)

    log_components = jax.vmap(component)(mixture.centres, mixture.whitenings)
    return jax.scipy.special.logsumexp(mixture.log_weights + log_components)
