"""Moves of one object within the present graph: walks, half turns and draws from a mixture.

A fair coin, part of the auxiliary variables, decides what becomes of all that rests on the object. Either
it is carried along: only the object's own parameters change. Or it stays in place: the contacts of the
object's children are recomputed and their prior enters the acceptance. Neither has a Jacobian: the change
of parameters given the auxiliary variables is an isometry of the base measure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from scene import pose_mixture
from scene.contact import FACE_AXES, Contact
from scene.graph import ROOT, SceneGraph, subtree
from scene.model import MOST_MOVED, SceneModel
from scene.pose_mixture import PoseMixture
from scene.prior import contact_of, log_pose_given_faces, pose_in_contact, sample_pose

_FLOATING_GROUPS = np.array(
    [[1, 1, 1, 0, 0, 0, 0], [0, 0, 0, 1, 1, 1, 0], [1, 1, 1, 1, 1, 1, 0]] * 2,
    float,
)
"""Coordinates that are walked together: translation (3), rotation vector (3), unused."""

_CONTACT_GROUPS = np.array(
    [
        [1, 1, 0, 0, 0, 0, 0],
        [0, 0, 1, 0, 0, 0, 0],
        [0, 0, 0, 1, 1, 1, 0],
        [0, 0, 0, 0, 0, 0, 1],
        [1, 1, 0, 0, 0, 0, 1],
        [1, 1, 1, 1, 1, 1, 1],
    ],
    float,
)
"""The same for a contact: a, b, z, rotation of eta (3), phi."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WalkMove:
    """A random walk in the active parametrisation.

    The size of a step is log-uniform between `scale` and `scale / spread`, and some groups of
    coordinates stand still: all of it symmetric, so that the density of the step cancels.

    Attributes:
        translation_m, rotation_rad: (C,) largest standard deviations of a step.
        spread: ratio of the largest to the smallest scale.
    """

    moves_bodies: ClassVar[bool] = True
    translation_m: jax.Array
    rotation_rad: jax.Array
    spread: jax.Array

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> tuple[jax.Array, ...]:  # noqa: ARG002
        """The scales of the chosen object, and whether it floats."""
        scales = self.translation_m[chosen], self.rotation_rad[chosen], self.spread
        return (*scales, scene.parents[chosen] == ROOT)

    def sample(self, key: jax.Array, context: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        """A step (7,) in the active coordinates, and the coin."""
        translation_m, rotation_rad, spread, floats = context
        choice_key, step_key = jax.random.split(key)
        dtype = translation_m.dtype
        choices = jax.random.uniform(choice_key, (3,), dtype)
        group = (choices[0] * len(_CONTACT_GROUPS)).astype(jnp.int32)
        groups = jnp.where(floats, jnp.asarray(_FLOATING_GROUPS), jnp.asarray(_CONTACT_GROUPS))
        scale = jnp.exp(-jnp.log(spread) * choices[1])
        units = jnp.concatenate([jnp.full(3, translation_m), jnp.full(4, rotation_rad)])
        step = scale * groups[group].astype(dtype) * units * jax.random.normal(step_key, (7,), dtype)
        return step, choices[2] < 0.5

    def log_density(
        self,
        context: tuple[jax.Array, ...],  # noqa: ARG002
        auxiliary: tuple[jax.Array, jax.Array],
    ) -> jax.Array:
        """Zero: a step and its opposite are equally likely."""
        return jnp.zeros((), auxiliary[0].dtype)

    def involution(
        self,
        model: SceneModel,
        scene: SceneGraph,
        chosen: jax.Array,
        auxiliary: tuple[jax.Array, jax.Array],
    ) -> tuple[SceneGraph, tuple[jax.Array, jax.Array], jax.Array]:
        """Take the step; the way back is its opposite."""
        step, carry = auxiliary
        pose = jaxlie.SE3(scene.poses[chosen])
        drifted = jaxlie.SE3.from_rotation_and_translation(
            pose.rotation() @ jaxlie.SO3.exp(step[3:6]), pose.translation() + step[:3]
        )
        contact = contact_of(model.bodies, scene, chosen)
        walked = Contact(
            contact.offset_m + step[:3],
            jaxlie.SO3.exp(step[3:6]).apply(contact.eta),
            contact.phi + step[6],
        )
        supported = pose_in_contact(model.bodies, scene, chosen, walked)
        pose_there = jnp.where(scene.parents[chosen] == ROOT, drifted.wxyz_xyz, supported)
        there = moved(scene, chosen, pose_there, carry)
        return there, (-step, carry), jnp.zeros((), pose_there.dtype)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FlipMove:
    """Half a turn about an axis of the bounding box: upside down or back to front in the same place.

    Faces are renamed with the turn, so that what was flush stays flush.
    """

    moves_bodies: ClassVar[bool] = True

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> tuple[()]:  # noqa: ARG002
        """Nothing."""
        return ()

    def sample(self, key: jax.Array, context: tuple[()]) -> tuple[jax.Array, jax.Array]:  # noqa: ARG002
        """An axis of the box, and the coin."""
        choice = jax.random.randint(key, (), 0, 6)
        return choice % 3, choice >= 3

    def log_density(self, context: tuple[()], auxiliary: tuple[jax.Array, jax.Array]) -> jax.Array:  # noqa: ARG002
        """Zero: the axis is uniform."""
        return jnp.zeros(())

    def involution(
        self,
        model: SceneModel,  # noqa: ARG002
        scene: SceneGraph,
        chosen: jax.Array,
        auxiliary: tuple[jax.Array, jax.Array],
    ) -> tuple[SceneGraph, tuple[jax.Array, jax.Array], jax.Array]:
        """Turn; the same turn leads back."""
        axis, carry = auxiliary
        dtype = scene.poses.dtype
        half_turn = jnp.concatenate([jnp.zeros(1, dtype), (jnp.arange(3) == axis).astype(dtype)])
        pose = jaxlie.SE3(scene.poses[chosen])
        turned = jaxlie.SE3.from_rotation_and_translation(
            pose.rotation() @ jaxlie.SO3(half_turn), pose.translation()
        )
        opposite = (jnp.asarray(FACE_AXES) != axis).astype(scene.child_faces.dtype)
        renamed = scene.parent_faces ^ opposite[scene.parent_faces]
        left_behind = (scene.parents == chosen) & ~carried_along(scene, chosen, carry)
        child_face = scene.child_faces[chosen]
        child_face = jnp.where(scene.parents[chosen] == ROOT, child_face, child_face ^ opposite[child_face])
        there = replace(
            moved(scene, chosen, turned.wxyz_xyz, carry),
            child_faces=scene.child_faces.at[chosen].set(child_face),
            parent_faces=jnp.where(left_behind, renamed, scene.parent_faces),
        )
        return there, auxiliary, jnp.zeros((), dtype)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _MixtureContext:
    mixture: PoseMixture
    model: SceneModel
    scene: SceneGraph
    chosen: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MixtureMove:
    """An absolute pose from the object's mixture or, with `prior_share`, from its prior under the graph.

    The proposal is one density of absolute poses, summed over all components, the prior's included
    (contact densities are converted to the measure of poses).

    Attributes:
        mixture: components of every object.
        prior_share: weight of the prior.
    """

    moves_bodies: ClassVar[bool] = True
    mixture: PoseMixture
    prior_share: jax.Array

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> _MixtureContext:
        """The chosen object's components, and the others' poses; its own pose is never looked at."""
        return _MixtureContext(self.mixture.of(chosen), model, scene, chosen)

    def sample(self, key: jax.Array, context: _MixtureContext) -> tuple[jax.Array, jax.Array]:
        """A pose (7,), and the coin."""
        pose_key, coin_key = jax.random.split(key)
        return self.pose(pose_key, context), jax.random.bernoulli(coin_key)

    def pose(self, key: jax.Array, context: _MixtureContext) -> jax.Array:
        """A pose (7,)."""
        choice_key, prior_key, component_key = jax.random.split(key, 3)
        model, scene, chosen = context.model, context.scene, context.chosen
        from_prior = sample_pose(prior_key, model.prior, model.bodies, scene, chosen)
        from_mixture = pose_mixture.sample(component_key, context.mixture)
        choice = jax.random.uniform(choice_key, dtype=self.prior_share.dtype)
        return _normalised(jnp.where(choice < self.prior_share, from_prior, from_mixture))

    def log_density(self, context: _MixtureContext, auxiliary: tuple[jax.Array, jax.Array]) -> jax.Array:
        """Log density of a pose in the measure of poses."""
        return self.log_density_of_pose(context, auxiliary[0])

    def log_density_of_pose(self, context: _MixtureContext, pose: jax.Array) -> jax.Array:
        """The same of a pose (7,)."""
        model, chosen = context.model, context.chosen
        there = at_pose(context.scene, chosen, pose)
        log_from_prior = log_pose_given_faces(model.prior, model.bodies, there, chosen)
        log_from_mixture = pose_mixture.log_density(context.mixture, pose)
        return jnp.logaddexp(
            jnp.log(self.prior_share) + log_from_prior, jnp.log1p(-self.prior_share) + log_from_mixture
        )

    def involution(
        self,
        model: SceneModel,  # noqa: ARG002
        scene: SceneGraph,
        chosen: jax.Array,
        auxiliary: tuple[jax.Array, jax.Array],
    ) -> tuple[SceneGraph, tuple[jax.Array, jax.Array], jax.Array]:
        """Swap the pose and the auxiliary one."""
        pose, carry = auxiliary
        return moved(scene, chosen, pose, carry), (scene.poses[chosen], carry), jnp.zeros((), pose.dtype)


def at_pose(scene: SceneGraph, chosen: jax.Array, pose: jax.Array) -> SceneGraph:
    """The scene with one object at another pose (7,), everything else in its place."""
    return replace(scene, poses=scene.poses.at[chosen].set(pose))


def moved(scene: SceneGraph, chosen: jax.Array, pose: jax.Array, carry: jax.Array) -> SceneGraph:
    """The scene with an object at a new pose (7,), its descendants carried along or left in place."""
    pose = _normalised(pose)
    motion = jaxlie.SE3(pose) @ jaxlie.SE3(scene.poses[chosen]).inverse()
    carried = jax.vmap(lambda old: _normalised((motion @ jaxlie.SE3(old)).wxyz_xyz))(scene.poses)
    along = carried_along(scene, chosen, carry)
    return replace(scene, poses=jnp.where(along[:, None], carried, scene.poses).at[chosen].set(pose))


def carried_along(scene: SceneGraph, chosen: jax.Array, carry: jax.Array) -> jax.Array:
    """The object and its descendants (C,) if they are to be carried and not more than MOST_MOVED."""
    along = subtree(scene.parents, chosen)
    return along & carry & (jnp.sum(along) <= MOST_MOVED)


def _normalised(pose: jax.Array) -> jax.Array:
    return jnp.concatenate([pose[:4] / jnp.linalg.norm(pose[:4]), pose[4:]])
