"""Moves of one object within the present graph: walks and half turns.

A fair coin, part of the auxiliary variables, decides what becomes of all that rests on the object. Either
it is carried along: only the object's own parameters change. Or it stays in place: the contacts of the
object's children are recomputed and their prior enters the acceptance. Neither has a Jacobian: the change
of parameters given the auxiliary variables is an isometry of the base measure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from scene.mcmc.random_variates import Variates
from scene.model.contact import FACE_AXES, Contact
from scene.model.posterior import MOST_MOVED, SceneModel
from scene.model.prior import contact_of, pose_in_contact
from scene.model.scene_graph import ROOT, SceneGraph, subtree
from shapes.geometry import quaternions

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


class Symmetric:
    """A move whose auxiliary variables are as likely both ways."""

    def log_density(self, context: Any, auxiliary: Any) -> jax.Array:  # noqa: ARG002
        """Zero."""
        return jnp.zeros(())


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class WalkMove(Symmetric):
    """A random walk in the active parametrisation.

    The size of a step is log-uniform between `scale` and `scale / spread`, and some groups of
    coordinates stand still: all of it symmetric, so that the density of the step cancels.

    Attributes:
        translation_m, rotation_rad: (C,) largest standard deviations of a step.
        spread: ratio of the largest to the smallest scale.
    """

    objects: ClassVar[int] = 1
    uniforms: ClassVar[int] = 3
    normals: ClassVar[int] = 7
    translation_m: jax.Array
    rotation_rad: jax.Array
    spread: jax.Array

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> tuple[jax.Array, ...]:  # noqa: ARG002
        """The scales of the chosen object, and whether it floats."""
        scales = self.translation_m[chosen], self.rotation_rad[chosen], self.spread
        return (*scales, scene.parents[chosen] == ROOT)

    def sample(self, dice: Variates, context: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        """A step (7,) in the active coordinates, and the coin."""
        translation_m, rotation_rad, spread, floats = context
        dtype = translation_m.dtype
        choices = dice.uniform
        group = (choices[0] * len(_CONTACT_GROUPS)).astype(jnp.int32)
        groups = jnp.where(floats, jnp.asarray(_FLOATING_GROUPS), jnp.asarray(_CONTACT_GROUPS))
        scale = jnp.exp(-jnp.log(spread) * choices[1])
        units = jnp.concatenate([jnp.full(3, translation_m), jnp.full(4, rotation_rad)])
        step = scale * groups[group].astype(dtype) * units * dice.normal[:7]
        return step, choices[2] < 0.5

    def involution(
        self,
        model: SceneModel,
        scene: SceneGraph,
        chosen: jax.Array,
        auxiliary: tuple[jax.Array, jax.Array],
    ) -> tuple[SceneGraph, tuple[jax.Array, jax.Array], jax.Array]:
        """Take the step; the way back is its opposite."""
        step, carry = auxiliary
        pose, turn = scene.poses[chosen], quaternions.exp(step[3:6])
        drifted = jnp.concatenate([quaternions.multiply(pose[:4], turn), pose[4:] + step[:3]])
        contact = contact_of(model.bodies, scene, chosen)
        walked = Contact(
            contact.offset_m + step[:3],
            quaternions.rotate(turn, contact.eta),
            contact.phi + step[6],
        )
        supported = pose_in_contact(model.bodies, scene, chosen, walked)
        pose_there = jnp.where(scene.parents[chosen] == ROOT, drifted, supported)
        there = displace(scene, chosen, pose_there, carry)
        return there, (-step, carry), jnp.zeros((), pose_there.dtype)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FlipMove(Symmetric):
    """Half a turn about an axis of the bounding box: upside down or back to front in the same place.

    Faces are renamed with the turn, so that what was flush stays flush.
    """

    objects: ClassVar[int] = 1
    uniforms: ClassVar[int] = 2
    normals: ClassVar[int] = 0

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> tuple[()]:  # noqa: ARG002
        """Nothing."""
        return ()

    def sample(self, dice: Variates, context: tuple[()]) -> tuple[jax.Array, jax.Array]:  # noqa: ARG002
        """An axis of the box, and the coin."""
        return (3 * dice.uniform[0]).astype(jnp.int32), dice.uniform[1] < 0.5

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
        pose = scene.poses[chosen]
        turned = jnp.concatenate([quaternions.multiply(pose[:4], half_turn), pose[4:]])
        opposite = (jnp.asarray(FACE_AXES) != axis).astype(scene.child_faces.dtype)
        renamed = scene.parent_faces ^ opposite[scene.parent_faces]
        left_behind = (scene.parents == chosen) & ~with_descendants(scene, chosen, carry)
        child_face = scene.child_faces[chosen]
        child_face = jnp.where(scene.parents[chosen] == ROOT, child_face, child_face ^ opposite[child_face])
        there = replace(
            displace(scene, chosen, turned, carry),
            child_faces=scene.child_faces.at[chosen].set(child_face),
            parent_faces=jnp.where(left_behind, renamed, scene.parent_faces),
        )
        return there, auxiliary, jnp.zeros((), dtype)


def displace(scene: SceneGraph, chosen: jax.Array, pose: jax.Array, carry: jax.Array) -> SceneGraph:
    """The scene with an object at a new pose (7,), its descendants carried along or left in place."""
    pose, before = normalise(pose), scene.poses[chosen]
    turn = quaternions.multiply(pose[:4], quaternions.inverse(before[:4]))

    def follow(old: jax.Array) -> jax.Array:
        position = pose[4:] + quaternions.rotate(turn, old[4:] - before[4:])
        return normalise(jnp.concatenate([quaternions.multiply(turn, old[:4]), position]))

    carried = jax.vmap(follow)(scene.poses)
    along = with_descendants(scene, chosen, carry)
    return replace(scene, poses=jnp.where(along[:, None], carried, scene.poses).at[chosen].set(pose))


def with_descendants(scene: SceneGraph, chosen: jax.Array, carry: jax.Array) -> jax.Array:
    """The object and its descendants (C,) if they are to be carried and not more than MOST_MOVED."""
    along = subtree(scene.parents, chosen)
    return along & carry & (jnp.sum(along) <= MOST_MOVED)


def normalise(pose: jax.Array) -> jax.Array:
    """A pose (7,) whose quaternion has length 1."""
    return jnp.concatenate([quaternions.normalise(pose[:4]), pose[4:]])
