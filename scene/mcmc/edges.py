"""Moves on the edges of two objects at once, and the table of an object's possible edges.

Edges are indexed with the root first, then every parent with each pair of faces. Two edges change together
since a stack read the other way round is as probable where both faces touch flush, while the state between,
with one edge less, is not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp

from scene.mcmc.random_variates import Variates, draw_index
from scene.model.posterior import SceneModel
from scene.model.prior import contact_densities, log_floating
from scene.model.scene_graph import ROOT, SceneGraph, subtree
from shapes.geometry.rotation_densities import LOG_CONTACT_JACOBIAN


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EdgeTables:
    """What the edges of two objects are drawn from, which does not depend on those that they have.

    Attributes:
        elsewhere: (2, 1 + 36 C) weights of edges that lead neither to the other nor to what is on it.
        upon: (2, 1 + 36 C) of those that do.
        alone: whether the two are one and the same.
    """

    elsewhere: jax.Array
    upon: jax.Array
    alone: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EdgeMove:
    """New edges for two objects, every pair as likely.

    Both are drawn together from p(theta' | G') x (8 for each contact) over all pairs of edges without a
    circle, given the graph without both: the same table both ways, and a Gibbs step where p(G) weighs
    nothing but floating objects.
    A single object gets an edge alone.
    """

    objects: ClassVar[int] = 2
    uniforms: ClassVar[int] = 3
    normals: ClassVar[int] = 0

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> EdgeTables:
        """The tables of both."""
        severed = scene.parents.at[chosen].set(ROOT)
        below = jax.vmap(lambda top: subtree(severed, top))(chosen)
        alone = chosen[0] == chosen[1]
        outside = scene.present & ~jnp.any(below, axis=0)
        upon = below[::-1] & scene.present[None] & ~alone
        elsewhere = jnp.broadcast_to(outside[None], below.shape)
        floating, on_parents = jax.vmap(partial(edge_weights, model, scene.poses))(
            chosen, jnp.stack([elsewhere, upon], axis=1)
        )
        heads = jnp.stack([floating, jnp.zeros_like(floating)], axis=1)
        tables = jnp.concatenate([heads[..., None], on_parents], axis=2)
        return EdgeTables(tables[:, 0], tables[:, 1], alone)

    def sample(self, dice: Variates, context: EdgeTables) -> jax.Array:
        """Whether one of the two rests on the other; then the places (2,) of both in their tables."""
        apart, upon = jnp.sum(context.elsewhere, axis=1), jnp.sum(context.upon, axis=1)
        ways = jnp.stack([apart[0] * apart[1], upon[0] * apart[1], apart[0] * upon[1]])
        way = draw_index(ways, dice.uniform[0])
        on_other = way == jnp.arange(1, 3)
        rows = jnp.where(on_other[:, None], context.upon, context.elsewhere)
        places = jax.vmap(draw_index)(rows, dice.uniform[1:3])
        return jnp.where(context.alone, places[0], places)

    def log_density(self, context: EdgeTables, auxiliary: jax.Array) -> jax.Array:
        """Log weight of two places; the sum over all cancels."""
        weights = context.elsewhere + context.upon
        log_each = jnp.log(jnp.take_along_axis(weights, auxiliary[:, None], axis=1)[:, 0])
        return log_each[0] + jnp.where(context.alone, 0.0, log_each[1])

    def involution(
        self,
        model: SceneModel,  # noqa: ARG002
        scene: SceneGraph,
        chosen: jax.Array,
        auxiliary: jax.Array,
    ) -> tuple[SceneGraph, jax.Array, jax.Array]:
        """Graft both, and remember the old places; |det| is 8 for each contact gained."""
        old = jax.vmap(partial(edge_index, scene))(chosen).astype(auxiliary.dtype)
        there = with_edge(with_edge(scene, chosen[0], auxiliary[0]), chosen[1], auxiliary[1])
        gained = (old == 0).astype(scene.poses.dtype) - (auxiliary == 0)
        two = gained[0] + jnp.where(chosen[0] == chosen[1], 0.0, gained[1])
        return there, old, LOG_CONTACT_JACOBIAN * two


_FACE_PAIRS = 36


def edge_weights(
    model: SceneModel, poses: jax.Array, chosen: jax.Array, parents: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Densities p(theta' | edge) p(edge) of an object's pose, in the measure of poses, under each edge.

    Args:
        model: the target.
        poses: (C, 7).
        chosen: the object.
        parents: (..., C) whom it may rest on.

    Returns:
        Floating, () and on each parent by each pair of faces (..., 36 C).
    """
    contacts = jnp.exp(LOG_CONTACT_JACOBIAN) * contact_densities(model.prior, model.bodies, poses, chosen)
    floating = log_floating(model.prior, poses[chosen, 4:]) + model.structure.log_floating_odds()
    on_parents = jnp.where(parents[..., None, None], contacts, 0.0)
    return jnp.exp(floating), on_parents.reshape(*parents.shape[:-1], -1)


def edge_index(scene: SceneGraph, chosen: jax.Array) -> jax.Array:
    """The place in the table of an object's edge."""
    pair = scene.parent_faces[chosen] * 6 + scene.child_faces[chosen]
    return jnp.where(scene.parents[chosen] == ROOT, 0, 1 + scene.parents[chosen] * _FACE_PAIRS + pair)


def with_edge(scene: SceneGraph, chosen: jax.Array, place: jax.Array) -> SceneGraph:
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
