"""Where objects are born: from the prior of a leaf, or from a mixture of Gaussians as well."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp

from scene.mcmc import pose_mixture
from scene.mcmc.edges import edge_weights
from scene.mcmc.pose_mixture import PoseMixture
from scene.mcmc.random_variates import Variates, draw_index
from scene.mcmc.walks import normalise
from scene.model.posterior import SceneModel
from scene.model.prior import POSE_UNIFORMS, sample_pose, supporting_face_probabilities
from scene.model.scene_graph import SceneGraph

_FACES = 6


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LeafPrior:
    """The prior of a leaf: a parent among those that are there, then its pose.

    Attributes:
        grafts: whether it may rest on others; else it floats.
    """

    grafts: bool = field(metadata={"static": True})

    @property
    def uniforms(self) -> int:
        """Those of parent, faces and pose."""
        return 3 + POSE_UNIFORMS

    @property
    def normals(self) -> int:
        """None."""
        return 0

    def sample(self, dice: Variates, model: SceneModel, scene: SceneGraph, slot: jax.Array) -> jax.Array:
        """A pose (7,)."""
        uniform = dice.uniform
        if self.grafts:
            weights = self._parents(model, scene)
            parent = draw_index(weights, uniform[0]) - 1
            at = jnp.maximum(parent, 0)
            faces = supporting_face_probabilities(
                model.prior, model.bodies.supporting_faces[at], scene.poses[at]
            )
            child_face = jnp.minimum((uniform[2] * _FACES).astype(jnp.int32), _FACES - 1)
            scene = replace(
                scene,
                parents=scene.parents.at[slot].set(parent.astype(scene.parents.dtype)),
                parent_faces=scene.parent_faces.at[slot].set(
                    draw_index(faces, uniform[1]).astype(scene.parents.dtype)
                ),
                child_faces=scene.child_faces.at[slot].set(child_face.astype(scene.parents.dtype)),
            )
        return sample_pose(uniform[3:], model.prior, model.bodies, scene, slot)

    def log_density(
        self, model: SceneModel, scene: SceneGraph, slot: jax.Array, pose: jax.Array
    ) -> jax.Array:
        """Summed over parents and faces."""
        there = scene.present & (jnp.arange(len(scene.present)) != slot) & self.grafts
        poses = scene.poses.at[slot].set(pose)
        floating, contacts = edge_weights(model, poses, slot, there)
        total = jnp.sum(self._parents(model, scene)) if self.grafts else jnp.exp(self._log_root(model))
        return jnp.log(floating + jnp.sum(contacts)) - jnp.log(total)

    def _parents(self, model: SceneModel, scene: SceneGraph) -> jax.Array:
        """Weights (1 + C), the root first."""
        return jnp.append(jnp.exp(self._log_root(model)), scene.present.astype(scene.poses.dtype))

    @staticmethod
    def _log_root(model: SceneModel) -> jax.Array:
        return model.structure.log_floating_odds()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MixtureBirths:
    """Poses near those that the image suggests, with `prior_share` of the leaf's prior.

    Attributes:
        mixture: components of every slot.
        prior: of a leaf.
        prior_share: its weight.
    """

    mixture: PoseMixture
    prior: LeafPrior
    prior_share: jax.Array

    @property
    def uniforms(self) -> int:
        """Those of the choice, the component and the prior."""
        return 2 + self.prior.uniforms

    @property
    def normals(self) -> int:
        """Of a Gaussian."""
        return 6

    def sample(self, dice: Variates, model: SceneModel, scene: SceneGraph, slot: jax.Array) -> jax.Array:
        """A pose (7,)."""
        from_prior = self.prior.sample(dice.without(2), model, scene, slot)
        suggested = pose_mixture.sample(dice.uniform[1], dice.normal, self.mixture.of(slot))
        return normalise(jnp.where(dice.uniform[0] < self.prior_share, from_prior, suggested))

    def log_density(
        self, model: SceneModel, scene: SceneGraph, slot: jax.Array, pose: jax.Array
    ) -> jax.Array:
        """Summed over all components."""
        return jnp.logaddexp(
            jnp.log(self.prior_share) + self.prior.log_density(model, scene, slot, pose),
            jnp.log1p(-self.prior_share) + pose_mixture.log_density(self.mixture.of(slot), pose),
        )
