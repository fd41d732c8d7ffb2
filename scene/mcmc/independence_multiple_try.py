"""Multiple-try moves with an independence proposal: one of several poses anywhere, from a mixture.

The proposal of an object's pose is its mixture of Gaussians plus its prior, whatever its present pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import jax
import jax.numpy as jnp

from scene.mcmc import pose_mixture
from scene.mcmc.face_relabelling import at_reference, placed
from scene.mcmc.involution import CandidateSet
from scene.mcmc.pose_mixture import PoseMixture
from scene.mcmc.random_variates import Variates, draw_object
from scene.mcmc.walks import normalise
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
        return 1 + (self.count - 1) * (2 + POSE_UNIFORMS)

    @property
    def normals(self) -> int:
        """Numbers that a draw takes."""
        return 6 * (self.count - 1)

    def propose(self, model: SceneModel, dice: Variates, state: ChainState) -> CandidateSet:
        """The scenes, of which one is to be chosen."""
        scene = state.scene
        chosen = draw_object(scene.present & model.bodies.movable, dice.uniform[0])
        turned = at_reference(scene, chosen, self.mixture.centres[chosen, 0])
        own = self.mixture.of(chosen)
        each = Variates(
            dice.uniform[1 : self.uniforms].reshape(self.count - 1, -1),
            dice.normal[: self.normals].reshape(self.count - 1, -1),
        )
        drawn = jax.vmap(partial(self._drawn, own, model, turned, chosen))(each)
        poses = jnp.concatenate([scene.poses[chosen][None], drawn])
        scenes = jax.vmap(partial(placed, turned, chosen))(poses)
        log_offered = jax.vmap(partial(self._log_density, own, model, turned, chosen))(poses)
        return CandidateSet(scenes, log_offered)

    def _drawn(
        self, own: PoseMixture, model: SceneModel, scene: SceneGraph, chosen: jax.Array, dice: Variates
    ) -> jax.Array:
        """A pose (7,) from the object's own mixture or, with `prior_share`, from its prior."""
        from_prior = sample_pose(dice.uniform[2:], model.prior, model.bodies, scene, chosen)
        from_mixture = pose_mixture.sample(dice.uniform[1], dice.normal, own)
        return normalise(jnp.where(dice.uniform[0] < self.prior_share, from_prior, from_mixture))

    def _log_density(
        self, own: PoseMixture, model: SceneModel, scene: SceneGraph, chosen: jax.Array, pose: jax.Array
    ) -> jax.Array:
        """Log density of a pose (7,) in the measure of poses, summed over all components and the prior."""
        there = replace(scene, poses=scene.poses.at[chosen].set(pose))
        log_from_prior = log_pose_given_faces(model.prior, model.bodies, there, chosen)
        log_from_mixture = pose_mixture.log_density(own, pose)
        return jnp.logaddexp(
            jnp.log(self.prior_share) + log_from_prior, jnp.log1p(-self.prior_share) + log_from_mixture
        )
