"""Multiple-try moves with an independence proposal: one of several poses anywhere, from a mixture.

The proposal of an object's pose is its mixture of Gaussians plus its prior, whatever its present pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp

from scene.mcmc import pose_mixture
from scene.mcmc.face_relabelling import at_reference, placed
from scene.mcmc.involution import CandidateSet
from scene.mcmc.pose_mixture import PoseMixture
from scene.mcmc.random_variates import Variates, draw_object
from scene.mcmc.walks import at_pose, normalise
from scene.model.posterior import ChainState, SceneModel
from scene.model.prior import POSE_UNIFORMS, log_pose_given_faces, sample_pose
from scene.model.scene_graph import SceneGraph


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class IndependenceMultipleTry:
    """One of K poses, the present one x among them; the graph stays as it is.

    The other poses y are drawn from an offer's density q, and the choice is in proportion to pi / q (iterated
    sampling importance resampling, Andrieu, Lee and Vihola 2018): the joint density pi(x) prod q(y), times
    the chance of the choice, is symmetric in who of the K is the present one. Names of faces are as in
    `LocalMultipleTry`, and q is as if each pose had its own.

    Attributes:
        mixture: where each object might be.
        prior_share: of the draws, from the prior instead.
        count: K.
    """

    mixture: PoseMixture
    prior_share: jax.Array
    count: int = field(metadata={"static": True})

    @property
    def uniforms(self) -> int:
        """Numbers that a draw takes: the object's, and those of the offers."""
        return 1 + (self.count - 1) * MixtureProposal.uniforms

    @property
    def normals(self) -> int:
        """Numbers that a draw takes."""
        return (self.count - 1) * MixtureProposal.normals

    def propose(self, dice: Variates, model: SceneModel, state: ChainState) -> CandidateSet:
        """The scenes, of which one is to be chosen."""
        scene, offer = state.scene, MixtureProposal(self.mixture, self.prior_share)
        chosen = draw_object(scene.present & model.bodies.movable, dice.uniform[0])
        turned = at_reference(scene, chosen, self.mixture.centres[chosen, 0])
        context = offer.context(model, turned, chosen)
        each = Variates(
            dice.uniform[1 : self.uniforms].reshape(self.count - 1, -1),
            dice.normal[: self.normals].reshape(self.count - 1, -1),
        )
        drawn = jax.vmap(partial(offer.sample, context=context))(each)
        poses = jnp.concatenate([scene.poses[chosen][None], drawn])
        scenes = jax.vmap(partial(placed, turned, chosen))(poses)
        log_offered = jax.vmap(partial(offer.log_density, context))(poses)
        return CandidateSet(scenes, log_offered)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ProposalContext:
    """One object's components, and everything else."""

    mixture: PoseMixture
    model: SceneModel
    scene: SceneGraph
    chosen: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MixtureProposal:
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

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> ProposalContext:
        """The chosen object's components, and the others' poses; its own pose is never looked at."""
        return ProposalContext(self.mixture.of(chosen), model, scene, chosen)

    def sample(self, dice: Variates, context: ProposalContext) -> jax.Array:
        """A pose (7,)."""
        model, scene, chosen = context.model, context.scene, context.chosen
        from_prior = sample_pose(dice.uniform[2:], model.prior, model.bodies, scene, chosen)
        from_mixture = pose_mixture.sample(dice.uniform[1], dice.normal, context.mixture)
        return normalise(jnp.where(dice.uniform[0] < self.prior_share, from_prior, from_mixture))

    def log_density(self, context: ProposalContext, pose: jax.Array) -> jax.Array:
        """Log density of a pose (7,) in the measure of poses."""
        model, chosen = context.model, context.chosen
        there = at_pose(context.scene, chosen, pose)
        log_from_prior = log_pose_given_faces(model.prior, model.bodies, there, chosen)
        log_from_mixture = pose_mixture.log_density(context.mixture, pose)
        return jnp.logaddexp(
            jnp.log(self.prior_share) + log_from_prior, jnp.log1p(-self.prior_share) + log_from_mixture
        )
