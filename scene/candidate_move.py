"""Moves of one object to one of several poses that are weighed side by side.

The likelihood of a pose is rugged: a pixel at an outline that changes sides costs some nats, several times
a millimetre. Most single proposals are refused; of several, one is about as good as the present pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie

from scene.graph import SceneGraph
from scene.involution import Proposal, choose_object
from scene.model import ChainState, SceneModel
from scene.pose_moves import MixtureMove, at_pose
from scene.shape_choices import candidate_keys

SMALLEST, LARGEST = 0.15, 1.2
"""Scales of near steps over the standard deviations of the pose, log-uniform between these."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CandidateMove:
    """One of K poses, the present one x among them, by two ways that a coin chooses between.

    Far: K - 1 poses y are drawn from the offer's density q, and the choice is in proportion to pi / q
    (iterated sampling importance resampling, Andrieu, Lee and Vihola 2018). Near: a point z is drawn round
    x and K - 1 poses y round z, all by one symmetric step k, and the choice is in proportion to pi
    (Tjelmeland 2004). The joint densities pi(x) prod q(y) and pi(x) k(x, z) prod k(z, y), times the chance
    of the choice, are symmetric in who of the K is the present one: as an involution, with the place of
    the choice as auxiliary variable, h swaps two poses and the weight is 1.

    What rests on the object stays where it is.

    Attributes:
        offer: draws the far candidates; a near step has the covariance of its mixture's first component.
        near_share: how often near candidates are drawn.
        axes: (C,) the box axis about which an object is round, or -1; half of the near steps spin it not: a
            scan's little bumps make many narrow modes of a round object's spin.
        count: K.
    """

    offer: MixtureMove
    near_share: jax.Array
    axes: jax.Array
    count: int = field(metadata={"static": True})

    def propose(self, key: jax.Array, model: SceneModel, state: ChainState) -> Proposal:
        """The pose that was chosen; nothing is left to accept."""
        object_key, pose_key, draw_key, choice_key = jax.random.split(key, 4)
        scene = state.scene
        chosen = choose_object(object_key, scene.present & model.bodies.movable)
        poses, log_offered = self._poses(pose_key, model, scene, chosen)
        scenes = jax.vmap(partial(at_pose, scene, chosen))(poses)
        log_priors = jax.vmap(model.log_prior)(scenes)
        draw_keys = candidate_keys(draw_key, self.count)
        log_likelihoods = model.likelihood.of_candidates(draw_keys, scene, chosen, poses, state.estimate)
        place = jax.random.categorical(choice_key, log_priors + log_likelihoods - log_offered)
        certain, no_error = jnp.full_like(state.log_prior, jnp.inf), jnp.zeros_like(state.log_prior)
        again = jax.random.clone(draw_keys)[place]
        return Proposal(at_pose(scene, chosen, poses[place]), certain, again, no_error)

    def _poses(
        self, key: jax.Array, model: SceneModel, scene: SceneGraph, chosen: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The poses (K, 7), the present one first, and the log densities (K,) by which they were drawn."""
        coin_key, far_key, scale_key, step_key = jax.random.split(key, 4)
        dtype = scene.poses.dtype
        present = scene.poses[chosen]
        context = self.offer.context(model, scene, chosen)
        far = jax.vmap(partial(self.offer.pose, context=context))(jax.random.split(far_key, self.count - 1))
        uniform = jax.random.uniform(scale_key, (2,), dtype)
        scale = SMALLEST * (LARGEST / SMALLEST) ** uniform[0]
        normal = jax.random.normal(step_key, (self.count, 6), dtype)
        steps = scale * jnp.sum(context.mixture.choleskys[:1] * normal[:, None], axis=2)
        still = (jnp.arange(6) == self.axes[chosen] + 3) & (self.axes[chosen] >= 0) & (uniform[1] < 0.5)
        steps = jnp.where(still[None], 0.0, steps)
        turn = jaxlie.SO3(context.mixture.centres[0, :4]).as_matrix()
        steps = jnp.concatenate([steps[:, :3], steps[:, 3:] @ turn.T], axis=1)
        centre = stepped(present, steps[0])
        near = jax.vmap(partial(stepped, centre))(steps[1:])
        is_near = jax.random.uniform(coin_key, dtype=dtype) < self.near_share
        poses = jnp.concatenate([present[None], jnp.where(is_near, near, far)])
        log_offered = jax.vmap(partial(self.offer.log_density_of_pose, context))(poses)
        return poses, jnp.where(is_near, 0.0, log_offered)


def stepped(pose: jax.Array, step: jax.Array) -> jax.Array:
    """The pose (7,) after an offset and a rotation vector, (6,) together, both along the world's axes.

    What the images tell of an object's tilt does not turn with a spin of a round object.
    """
    turned = jaxlie.SO3.exp(step[3:]) @ jaxlie.SO3(pose[:4])
    return jnp.concatenate([turned.wxyz / jnp.linalg.norm(turned.wxyz), pose[4:] + step[:3]])
