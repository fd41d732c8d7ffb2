"""The move on the graph: sever a subtree, graft it elsewhere, leave every absolute pose where it is."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp

from scene.graph import ROOT, SceneGraph, subtree
from scene.model import SceneModel
from scene.prior import log_contacts_of, log_floating
from scene.rotation_densities import LOG_CONTACT_JACOBIAN

_FACE_PAIRS = 36


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StructureMove:
    """Supplement O.5: a new parent and two faces for one object, from one categorical table.

    The auxiliary variable is a place in the table over {root} + {u outside the object's subtree} x
    faces, root first. The table is a function of the absolute poses and of the graph without the
    object's own edge: the same both ways.

    Attributes:
        proposal: "posterior" takes p(G') p(theta' | G') x (8 for a contact) as table, a Gibbs step under
            a likelihood of poses alone; "uniform" takes u uniform, then faces uniform.
    """

    moves_bodies: ClassVar[bool] = False
    proposal: Literal["posterior", "uniform"] = field(default="posterior", metadata={"static": True})

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> jax.Array:
        """Log weights (1 + 36 C,) of the table, not normalised."""
        bodies, prior = model.bodies, model.prior
        candidates = scene.present & ~subtree(scene.parents, chosen)
        if self.proposal == "uniform":
            faces = candidates[:, None, None] & bodies.supporting_faces[:, :, None]
            pairs = jnp.maximum(6 * jnp.sum(bodies.supporting_faces, axis=-1), 1)[:, None, None]
            weights = jnp.broadcast_to(jnp.where(faces, 1.0 / pairs, 0.0), (len(candidates), 6, 6))
            return jnp.log(jnp.concatenate([jnp.ones(1, weights.dtype), weights.ravel()]))
        log_contacts = log_contacts_of(prior, bodies, scene.poses, chosen) + LOG_CONTACT_JACOBIAN
        log_trees = _log_structure_of_each_parent(model, scene, chosen)
        log_contacts = jnp.where(
            candidates[:, None, None], log_contacts + log_trees[1:, None, None], -jnp.inf
        )
        log_root = log_trees[:1] + log_floating(prior, scene.poses[chosen, 4:])
        return jnp.concatenate([log_root, log_contacts.ravel()])

    def sample(self, key: jax.Array, context: jax.Array) -> jax.Array:
        """A place in the table: the parent first, then its face, then the child's."""
        uniform = jax.random.uniform(key, (3,), context.dtype)
        weights = jnp.exp(context - jnp.max(context))
        pairs = weights[1:].reshape(-1, 6, 6)
        faces = jnp.sum(pairs, axis=2)
        parent = inverse_cdf(jnp.concatenate([weights[:1], jnp.sum(faces, axis=1)]), uniform[0])
        above = jnp.maximum(parent - 1, 0)
        parent_face = inverse_cdf(faces[above], uniform[1])
        child_face = inverse_cdf(pairs[above, parent_face], uniform[2])
        return jnp.where(parent == 0, 0, 1 + above * _FACE_PAIRS + parent_face * 6 + child_face)

    def log_density(self, context: jax.Array, auxiliary: jax.Array) -> jax.Array:
        """Log weight of a place; the sum of the table cancels."""
        return context[auxiliary]

    def involution(
        self,
        model: SceneModel,  # noqa: ARG002
        scene: SceneGraph,
        chosen: jax.Array,
        auxiliary: jax.Array,
    ) -> tuple[SceneGraph, jax.Array, jax.Array]:
        """Graft, and remember the old place; floating to contact has |det| 8, the way back 1/8."""
        old_place = place_of(scene, chosen)
        gained = contacts_gained(old_place, auxiliary).astype(scene.poses.dtype)
        return (
            grafted(scene, chosen, auxiliary),
            old_place.astype(auxiliary.dtype),
            LOG_CONTACT_JACOBIAN * gained,
        )


def place_of(scene: SceneGraph, chosen: jax.Array) -> jax.Array:
    """The place in the table of an object's edge."""
    pair = scene.parent_faces[chosen] * 6 + scene.child_faces[chosen]
    return jnp.where(scene.parents[chosen] == ROOT, 0, 1 + scene.parents[chosen] * _FACE_PAIRS + pair)


def grafted(scene: SceneGraph, chosen: jax.Array, place: jax.Array) -> SceneGraph:
    """The scene with the object's edge at another place of the table."""
    floats = place == 0
    pair = jnp.where(floats, 0, place - 1)
    parent = jnp.where(floats, ROOT, pair // _FACE_PAIRS).astype(scene.parents.dtype)
    faces = (pair % _FACE_PAIRS).astype(scene.parents.dtype)
    return replace(
        scene,
        parents=scene.parents.at[chosen].set(parent),
        parent_faces=scene.parent_faces.at[chosen].set(faces // 6),
        child_faces=scene.child_faces.at[chosen].set(faces % 6),
    )


def contacts_gained(old_place: jax.Array, new_place: jax.Array) -> jax.Array:
    """1 from floating to contact, -1 the way back, else 0."""
    return (old_place == 0).astype(jnp.int32) - (new_place == 0).astype(jnp.int32)


def inverse_cdf(weights: jax.Array, uniform: jax.Array) -> jax.Array:
    """Place in a short table (n,) of weights; the last place with a weight ends the table."""
    cumulative = jnp.cumsum(weights)
    place = jnp.sum(cumulative <= uniform * cumulative[-1])
    return jnp.minimum(place, len(weights) - 1 - jnp.argmax(weights[::-1] > 0))


def _log_structure_of_each_parent(model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> jax.Array:
    """Log p(G') (1 + C,) with the chosen object under the root, then under every object."""
    parents = jnp.arange(ROOT, len(scene.parents), dtype=scene.parents.dtype)

    def log_density(parent: jax.Array) -> jax.Array:
        grafted = scene.parents.at[chosen].set(parent)
        return model.structure.log_density(grafted, scene.present, model.bodies.movable)

    return jax.vmap(log_density)(parents)
