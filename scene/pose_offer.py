"""Where an object might be, wherever it is now: its mixture of poses, and its prior."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from scene import pose_mixture
from scene.dice import Dice
from scene.graph import SceneGraph
from scene.model import SceneModel
from scene.pose_mixture import PoseMixture
from scene.pose_moves import at_pose, normalised
from scene.prior import POSE_UNIFORMS, log_pose_given_faces, sample_pose


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OfferContext:
    """One object's components, and everything else."""

    mixture: PoseMixture
    model: SceneModel
    scene: SceneGraph
    chosen: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseOffer:
    """An absolute pose from the object's mixture or, with `prior_share`, from its prior under the graph.

    The proposal is one density of absolute poses, summed over all components, the prior's included
    (contact densities are converted to the measure of poses).

    Attributes:
        mixture: components of every object.
        prior_share: weight of the prior.
    """

    uniforms: ClassVar[int] = 2 + POSE_UNIFORMS
    normals: ClassVar[int] = 6
    mixture: PoseMixture
    prior_share: jax.Array

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> OfferContext:
        """The chosen object's components, and the others' poses; its own pose is never looked at."""
        return OfferContext(self.mixture.of(chosen), model, scene, chosen)

    def sample(self, dice: Dice, context: OfferContext) -> jax.Array:
        """A pose (7,)."""
        model, scene, chosen = context.model, context.scene, context.chosen
        from_prior = sample_pose(dice.uniform[2:], model.prior, model.bodies, scene, chosen)
        from_mixture = pose_mixture.sample(dice.uniform[1], dice.normal, context.mixture)
        return normalised(jnp.where(dice.uniform[0] < self.prior_share, from_prior, from_mixture))

    def log_density(self, context: OfferContext, pose: jax.Array) -> jax.Array:
        """Log density of a pose (7,) in the measure of poses."""
        model, chosen = context.model, context.chosen
        there = at_pose(context.scene, chosen, pose)
        log_from_prior = log_pose_given_faces(model.prior, model.bodies, there, chosen)
        log_from_mixture = pose_mixture.log_density(context.mixture, pose)
        return jnp.logaddexp(
            jnp.log(self.prior_share) + log_from_prior, jnp.log1p(-self.prior_share) + log_from_mixture
        )
