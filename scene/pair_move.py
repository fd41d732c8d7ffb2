"""The move on the edges of two objects at once: a stack can be read the other way round.

That the lower of two boxes rests on the upper is as likely as the reverse where both touch flush, and what
lies between them, an edge less, is not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from scene.dice import Dice, drawn_object, drawn_place
from scene.edges import contacts_gained, grafted, place_of
from scene.graph import ROOT, SceneGraph, subtree
from scene.model import SceneModel
from scene.prior import log_contacts_of, log_floating
from scene.rotation_densities import LOG_CONTACT_JACOBIAN

Auxiliary = tuple[jax.Array, jax.Array]
"""The other object, and the places (2,) of both in their tables."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Context:
    model: SceneModel
    scene: SceneGraph
    chosen: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PairMove:
    """New edges for the chosen object and another one, which is uniform among the rest.

    Both are drawn together from p(theta' | G') x (8 for each contact) over all pairs of edges without a
    circle, given the graph without both: the same table both ways, and a Gibbs step where p(G) weighs
    nothing but floating objects.
    A single object gets an edge alone.
    """

    moves_bodies: ClassVar[bool] = False
    uniforms: ClassVar[int] = 4
    normals: ClassVar[int] = 0

    def context(self, model: SceneModel, scene: SceneGraph, chosen: jax.Array) -> _Context:
        """All of it; the edges of the two are never looked at."""
        return _Context(model, scene, chosen)

    def sample(self, dice: Dice, context: _Context) -> Auxiliary:
        """The other object; whether one of the two rests on the other; the places of both."""
        eligible = context.scene.present & context.model.bodies.movable
        rest = eligible & (jnp.arange(len(eligible)) != context.chosen)
        other = jnp.where(jnp.any(rest), drawn_object(rest, dice.uniform[3]), context.chosen)
        log_weights, elsewhere, upon = _tables(context, other)
        weights = jnp.exp(log_weights - jnp.max(log_weights, axis=1, keepdims=True))
        tables = jnp.stack([jnp.where(elsewhere, weights, 0), jnp.where(upon, weights, 0)], axis=1)
        (apart, on_other), (other_apart, other_on) = jnp.sum(tables, axis=2)
        ways = jnp.stack([apart * other_apart, on_other * other_apart, apart * other_on])
        way = drawn_place(ways, dice.uniform[0])
        rows = jnp.stack([tables[0, (way == 1).astype(jnp.int32)], tables[1, (way == 2).astype(jnp.int32)]])
        places = jax.vmap(drawn_place)(rows, dice.uniform[1:3])
        return other, jnp.where(other == context.chosen, places[0], places)

    def log_density(self, context: _Context, auxiliary: Auxiliary) -> jax.Array:
        """Log weight of two places; the sum over all cancels."""
        other, places = auxiliary
        log_weights, _, _ = _tables(context, other)
        each = jnp.take_along_axis(log_weights, places[:, None], axis=1)[:, 0]
        return each[0] + jnp.where(other == context.chosen, 0.0, each[1])

    def involution(
        self,
        model: SceneModel,  # noqa: ARG002
        scene: SceneGraph,
        chosen: jax.Array,
        auxiliary: Auxiliary,
    ) -> tuple[SceneGraph, Auxiliary, jax.Array]:
        """Graft both, and remember the old places; |det| is 8 for each contact gained."""
        other, places = auxiliary
        old = jnp.stack([place_of(scene, chosen), place_of(scene, other)]).astype(places.dtype)
        there = grafted(grafted(scene, chosen, places[0]), other, places[1])
        gained = contacts_gained(old, places).astype(scene.poses.dtype)
        log_jacobian = LOG_CONTACT_JACOBIAN * (gained[0] + jnp.where(other == chosen, 0.0, gained[1]))
        return there, (other, old), log_jacobian


def _tables(context: _Context, other: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Log weights (2, 1 + 36 C) of both objects' edges, which lead elsewhere, which upon the other."""
    model, scene, chosen = context.model, context.scene, context.chosen
    two = jnp.stack([chosen, other])
    severed = scene.parents.at[two].set(ROOT)
    below = jax.vmap(lambda top: subtree(severed, top))(two)
    outside = scene.present & ~jnp.any(below, axis=0)
    upon = below[::-1] & scene.present[None] & (other != chosen)

    def log_weights(one: jax.Array) -> jax.Array:
        contacts = log_contacts_of(model.prior, model.bodies, scene.poses, one) + LOG_CONTACT_JACOBIAN
        floating = log_floating(model.prior, scene.poses[one, 4:]) + model.structure.log_floating_odds()
        return jnp.concatenate([floating[None], contacts.ravel()])

    def over_places(parents: jax.Array, root: bool) -> jax.Array:
        return jnp.concatenate([jnp.full((2, 1), root), jnp.repeat(parents, 36, axis=1)], axis=1)

    elsewhere = over_places(jnp.broadcast_to(outside[None], below.shape), True)
    upon = over_places(upon, False)
    log_tables = jax.vmap(log_weights)(two)
    return jnp.where(elsewhere | upon, log_tables, -jnp.inf), elsewhere, upon
