"""Moves of one object to one of several poses that it might have, wherever it is now."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp

from scene.dice import Dice, drawn_object
from scene.involution import Offer
from scene.model import ChainState, SceneModel
from scene.pose_mixture import PoseMixture
from scene.pose_offer import PoseOffer
from scene.turned_faces import at_reference, placed


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FarCandidates:
    """One of K poses, the present one x among them; the graph stays as it is.

    The other poses y are drawn from an offer's density q, and the choice is in proportion to pi / q (iterated
    sampling importance resampling, Andrieu, Lee and Vihola 2018): the joint density pi(x) prod q(y), times
    the chance of the choice, is symmetric in who of the K is the present one. Names of faces are as in
    `NearCandidates`, and q is as if each pose had its own.

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
        return 1 + (self.count - 1) * PoseOffer.uniforms

    @property
    def normals(self) -> int:
        """Numbers that a draw takes."""
        return (self.count - 1) * PoseOffer.normals

    def propose(self, dice: Dice, model: SceneModel, state: ChainState) -> Offer:
        """The scenes, of which one is to be chosen."""
        scene, offer = state.scene, PoseOffer(self.mixture, self.prior_share)
        chosen = drawn_object(scene.present & model.bodies.movable, dice.uniform[0])
        turned = at_reference(scene, chosen, self.mixture.centres[chosen, 0])
        context = offer.context(model, turned, chosen)
        each = Dice(
            dice.uniform[1 : self.uniforms].reshape(self.count - 1, -1),
            dice.normal[: self.normals].reshape(self.count - 1, -1),
        )
        drawn = jax.vmap(partial(offer.sample, context=context))(each)
        poses = jnp.concatenate([scene.poses[chosen][None], drawn])
        scenes = jax.vmap(partial(placed, turned, chosen))(poses)
        log_offered = jax.vmap(partial(offer.log_density, context))(poses)
        return Offer(scenes, log_offered, jnp.zeros_like(state.log_prior))
