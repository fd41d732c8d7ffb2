"""The proposal q(x_t | particle): a mixture of Gaussians on local optima of the image density, and the prior.

A component is found once, for the map that a group of particles share on average. Each particle's own
keyframes sit slightly elsewhere; to first order its own optimum is shifted by
H^-1 sum_i H_i e_i, where e_i is the displacement of keyframe i and H_i the part of the curvature that
the pixels of keyframe i contribute (`Component.sensitivity`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie

from recordings.types import DepthNoise
from shapes.geometry import pose_gaussian
from slam.filter.motion import MotionHistory, MotionPrior
from slam.likelihood.image_density import ScoredPixels, log_image_density
from slam.registration.local_search import Optimum

PRIOR_SHARE = 0.05
"""Weight of the motion prior in every proposal, which bounds the importance weights."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Component:
    """A local optimum of the image density for one group of particles.

    Attributes:
        pose: (7,) reference_from_camera at the group's mean map.
        scale: (6, 6) lower triangular factor of its covariance, in the chart at `pose`.
        sensitivity: (M, 6, 6) H^-1 H_i, how the optimum follows each keyframe.
        log_score: unnormalised log weight.
        group: which particles it is for.
        keyframes: (M,) indices of the keyframes compared with.
        mean_keyframe_poses: (M, 7) reference_from_keyframe at the group's mean map.
        pixels: the image and what the map shows it.
    """

    pose: jax.Array
    scale: jax.Array
    sensitivity: jax.Array
    log_score: jax.Array
    group: jax.Array
    keyframes: jax.Array
    mean_keyframe_poses: jax.Array
    pixels: ScoredPixels


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Proposed:
    """One particle's draw.

    Attributes:
        pose: (7,) reference_from_camera.
        conditional_mean: (7,) this particle's centre of the component that the draw lies nearest to; the
            draw itself where no component is for the particle.
        component: index of that component, whose rendering scored the draw.
    """

    pose: jax.Array
    conditional_mean: jax.Array
    component: jax.Array


@jax.jit
def component_at(
    optimum: Optimum,
    mean_keyframe_poses: jax.Array,
    keyframes: jax.Array,
    group: jax.Array,
    history: MotionHistory,
    motion: MotionPrior,
    exponent: float,
) -> Component:
    """The optimum of the tempered image density times the motion prior, as a Gaussian.

    The prior enters by its Gauss-Newton terms at the image's optimum, for the past of one particle.
    """

    def residual(xi: jax.Array) -> jax.Array:
        return motion.whitened_residual(history, pose_gaussian.displace(optimum.pose, xi))

    zero = jnp.zeros(6, jnp.float32)
    jacobian, offset = jax.jacfwd(residual)(zero), residual(zero)
    precision = exponent * optimum.layer_precisions.sum(0) + jacobian.T @ jacobian
    covariance = jnp.linalg.inv(precision)
    covariance = 0.5 * (covariance + covariance.T)
    sensitivity = jnp.einsum("ij,mjk->mik", covariance, exponent * optimum.layer_precisions)
    return Component(
        pose=pose_gaussian.displace(optimum.pose, -covariance @ jacobian.T @ offset),
        scale=jnp.linalg.cholesky(covariance),
        sensitivity=sensitivity,
        log_score=exponent * optimum.log_density,
        group=group,
        keyframes=keyframes,
        mean_keyframe_poses=mean_keyframe_poses,
        pixels=optimum.pixels,
    )


def centre_for(component: Component, keyframe_poses: jax.Array) -> jax.Array:
    """The component's optimum (7,) for a particle whose M compared keyframes are at (M, 7)."""
    camera = jaxlie.SE3(component.pose)

    def displacement(own: jax.Array, mean: jax.Array) -> jax.Array:
        carried = jaxlie.SE3(own) @ jaxlie.SE3(mean).inverse() @ camera
        return pose_gaussian.coordinates(component.pose, carried.wxyz_xyz)

    displacements = jax.vmap(displacement)(keyframe_poses, component.mean_keyframe_poses)
    shift = jnp.einsum("mij,mj->i", component.sensitivity, displacements)
    return pose_gaussian.displace(component.pose, shift)


def log_proposal_density(
    pose: jax.Array,
    centres: jax.Array,
    scales: jax.Array,
    log_shares: jax.Array,
    history: MotionHistory,
    motion: MotionPrior,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log density (base measure of `pose_gaussian`) of the whole mixture at a pose (7,).

    Args:
        pose: where.
        centres: (J, 7).
        scales: (J, 6, 6).
        log_shares: (J,) normalised over the components, -inf where one is not for this particle.
        history: the particle's past.
        motion: the prior, which takes `PRIOR_SHARE`, or everything where no component is for it.

    Returns:
        log q, log of the prior's own density there, and the components' terms (J,).
    """
    log_prior = motion.log_density(history, pose)
    log_gaussians = jax.vmap(pose_gaussian.log_density, (None, 0, 0))(pose, centres, scales)
    any_component = jnp.isfinite(log_shares).any()
    prior_share = jnp.where(any_component, PRIOR_SHARE, 1.0)
    terms = log_shares + log_gaussians + jnp.log1p(-PRIOR_SHARE)
    terms = jnp.where(jnp.isfinite(log_shares), terms, -jnp.inf)
    log_mixture = jax.nn.logsumexp(jnp.append(terms, jnp.log(prior_share) + log_prior))
    return log_mixture, log_prior, terms


def propose(
    key: jax.Array,
    own_keyframes: jax.Array,
    group: jax.Array,
    history: MotionHistory,
    components: Component,
    motion: MotionPrior,
    noise: DepthNoise,
    exponent: jax.Array | float,
) -> tuple[Proposed, jax.Array]:
    """Draw and weigh one particle.

    Args:
        key: consumed.
        own_keyframes: (J, M, 7) where the particle has the components' keyframes.
        group: the particle's group.
        history: its past.
        components: J components, leaves stacked (J, ...).
        motion: the prior.
        noise: the sensor.
        exponent: tempering of the image density.

    Returns:
        The draw and log p(I | x, map) + log p(x | past) - log q(x).
    """
    component_key, gaussian_key, prior_key, prior_choice_key = jax.random.split(key, 4)
    for_particle = components.group == group
    log_scores = jnp.where(for_particle, components.log_score, -jnp.inf)
    log_shares = jnp.where(for_particle, log_scores - jax.nn.logsumexp(log_scores), -jnp.inf)
    centres = jax.vmap(centre_for)(components, own_keyframes)
    index = jax.random.categorical(component_key, log_shares)
    from_component = pose_gaussian.sample(gaussian_key, centres[index], components.scale[index])
    from_prior = motion.sample(prior_key, history)
    use_prior = jax.random.bernoulli(prior_choice_key, PRIOR_SHARE) | ~for_particle.any()
    pose = jnp.where(use_prior, from_prior, from_component)
    log_q, log_prior, terms = log_proposal_density(
        pose, centres, components.scale, log_shares, history, motion
    )
    only_one = len(centres) == 1
    nearest = 0 if only_one else jnp.argmax(terms)
    pixels = jax.tree.map(lambda leaf: leaf[nearest], components.pixels)
    camera = jaxlie.SE3(pose)
    keyframes_from_camera = jax.vmap(lambda own: (jaxlie.SE3(own).inverse() @ camera).wxyz_xyz)(
        own_keyframes[nearest]
    )
    log_image = log_image_density(pixels, keyframes_from_camera, noise, exponent)
    mean = jnp.where(for_particle.any(), centres[nearest], pose)
    return Proposed(pose, mean, jnp.asarray(nearest, jnp.int32)), log_image + log_prior - log_q


propose_all = partial(jax.vmap, in_axes=(0, 0, 0, 0, None, None, None, None))(propose)
"""`propose` for (K, ...) keys, maps, groups and histories."""
