"""Moves that change which objects are there: birth, death, swap and relocation of leaves in one.

A slot holds one copy of a shape or nothing. Of a pair of slots {a, b}, drawn whatever the state, K poses are
drawn for each, with edges of their own; where one of the pair is there it takes a place among its K. The
options are: neither is there, a at one of its poses, b at one of its. Their weights are

    pi(neither),    pi(c at y_k with its edge) / (K q_c(y_k) r(edge_k | y_k)),

with r in the state's measure (8 for a contact, `LOG_CONTACT_JACOBIAN`). The density of all 2 K poses is
common to the options, so that a choice in proportion to the weights, or `decide`'s, leaves pi invariant.
Nothing is done where both are there, or where the one that is carries another. One slot may be paired with
none: then the options are its absence and its K poses; without these moves two slots alone would never both
be there.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import jax
import jax.numpy as jnp

from scene.mcmc.edges import edge_index, edge_weights, with_edge
from scene.mcmc.involution import CandidateSet, compute_once
from scene.mcmc.random_variates import Variates, draw_index
from scene.model.posterior import ChainState, SceneModel
from scene.model.scene_graph import ROOT, SceneGraph
from shapes.geometry.rotation_densities import LOG_CONTACT_JACOBIAN

ABSENT_POSE = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Of what is not there: one and the same, so that nothing is remembered of where it was."""


class BirthProposal(Protocol):
    """Where objects are born: a density of absolute poses that does not look at the pair of slots."""

    @property
    def uniforms(self) -> int:
        """Uniform numbers of a draw."""
        ...

    @property
    def normals(self) -> int:
        """Normal numbers of a draw."""
        ...

    def sample(self, dice: Variates, model: SceneModel, scene: SceneGraph, slot: jax.Array) -> jax.Array:
        """A pose (7,)."""
        ...

    def log_density(
        self, model: SceneModel, scene: SceneGraph, slot: jax.Array, pose: jax.Array
    ) -> jax.Array:
        """Its log density, Lebesgue times rotations of mass pi^2."""
        ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ToggleOffer:
    """The options, the present scene first.

    Attributes:
        offer: their scenes and densities, (2 K + 1).
        placed: (2 K + 1, C) the object that an option puts somewhere else than it is.
    """

    offer: CandidateSet
    placed: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PairToggle:
    """The move.

    Attributes:
        births: where objects are born.
        count: K.
        grafts: whether edges are drawn with the poses; else all float.
    """

    births: BirthProposal
    count: int = field(metadata={"static": True})
    grafts: bool = field(metadata={"static": True})

    @property
    def uniforms(self) -> int:
        """Numbers that a draw takes: the pair, and of each pose its own and its edge's."""
        return 1 + 2 * self.count * (self.births.uniforms + 1)

    @property
    def normals(self) -> int:
        """Numbers that a draw takes."""
        return 2 * self.count * self.births.normals

    def propose(self, dice: Variates, model: SceneModel, state: ChainState) -> ToggleOffer:
        """Draw a pair and its poses."""
        slots = draw_pair(model.bodies.movable, dice.uniform[0])
        uniform = dice.uniform[1 : self.uniforms].reshape(2, self.count, -1)
        normal = dice.normal[: self.normals].reshape(2, self.count, -1)
        return self.options(slots, Variates(uniform, normal), model, state)

    def options(self, slots: jax.Array, dice: Variates, model: SceneModel, state: ChainState) -> ToggleOffer:
        """The options of a pair.

        Args:
            slots: (2,) two slots, the second C where there is none.
            dice: leaves (2, K, ...), of a pose and its edge.
            model: the target.
            state: the chain.
        """
        scene = state.scene
        size = len(scene.present)
        real = slots < size
        there = real & scene.present[jnp.minimum(slots, size - 1)]
        carries = jnp.any(scene.present[None] & (scene.parents[None] == slots[:, None]), axis=1)
        frozen = jnp.all(there) | jnp.any(there & carries)
        empty = without(without(scene, slots[0]), slots[1])

        def born(slot: jax.Array, is_there: jax.Array, dice: Variates) -> tuple[SceneGraph, jax.Array]:
            slot = jnp.minimum(slot, size - 1)
            scenes, log_offered = jax.vmap(lambda one: self._born(one, model, empty, slot))(dice)
            scenes = jax.tree.map(
                lambda drawn, now: drawn.at[0].set(jnp.where(is_there, now, drawn[0])), scenes, scene
            )
            kept = jnp.where(is_there, self._log_offered(model, empty, scene, slot), log_offered[0])
            return scenes, log_offered.at[0].set(kept)

        scenes, log_offered = jax.vmap(born)(slots, there, dice)
        scenes = jax.tree.map(
            lambda one, many: jnp.concatenate([one[None], many.reshape(-1, *one.shape)]), empty, scenes
        )
        log_offered = jnp.where(real[:, None], log_offered + jnp.log(self.count), jnp.inf)
        log_offered = jnp.concatenate([jnp.zeros(1, log_offered.dtype), log_offered.ravel()])
        options = jnp.arange(2 * self.count + 1)
        slot_of = jnp.where(options == 0, size, slots[(options > self.count).astype(jnp.int32)])
        now = jnp.where(there[0], 1, jnp.where(there[1], 1 + self.count, 0))
        placed = (slot_of[:, None] == jnp.arange(size)[None]) & (options != now)[:, None]
        order = jnp.where(options == 0, now, jnp.where(options == now, 0, options))
        scenes = jax.tree.map(lambda leaf: leaf[order], scenes)
        scenes = jax.tree.map(lambda leaf, same: leaf.at[0].set(same), scenes, scene)
        log_offered = jnp.where(frozen & (options > 0), jnp.inf, log_offered[order])
        log_offered = jnp.where(frozen & (options == 0), 0.0, log_offered)
        offer = CandidateSet(scenes, log_offered, jnp.zeros_like(state.log_prior))
        return compute_once(ToggleOffer(offer, placed[order]))

    def _born(
        self, dice: Variates, model: SceneModel, empty: SceneGraph, slot: jax.Array
    ) -> tuple[SceneGraph, jax.Array]:
        """A scene with the slot's object at a pose that is drawn, and log q r."""
        pose = self.births.sample(dice.without(1), model, empty, slot)
        scene = replace(empty, poses=empty.poses.at[slot].set(pose), present=empty.present.at[slot].set(True))
        if self.grafts:
            weights = edge_table(model, scene, empty.present, slot)
            scene = with_edge(scene, slot, draw_index(weights, dice.uniform[0]))
        return scene, self._log_offered(model, empty, scene, slot)

    def _log_offered(
        self, model: SceneModel, empty: SceneGraph, scene: SceneGraph, slot: jax.Array
    ) -> jax.Array:
        """Log q of the object's pose, and of its edge given the pose, in the state's measure."""
        log_pose = self.births.log_density(model, empty, slot, scene.poses[slot])
        if not self.grafts:
            return log_pose
        weights, place = edge_table(model, scene, empty.present, slot), edge_index(scene, slot)
        log_edge = jnp.log(weights[place]) - jnp.log(jnp.sum(weights))
        log_edge -= jnp.where(place > 0, LOG_CONTACT_JACOBIAN, 0.0)
        return jnp.where(weights[place] > 0, log_pose + log_edge, jnp.inf)


def edge_table(model: SceneModel, scene: SceneGraph, parents: jax.Array, slot: jax.Array) -> jax.Array:
    """Weights (1 + 36 C) of the edges of a leaf at its pose, on those that are there without it."""
    floating, contacts = edge_weights(model, scene.poses, slot, parents)
    return jnp.concatenate([floating[None], contacts])


def without(scene: SceneGraph, slot: jax.Array) -> SceneGraph:
    """The scene without one object; a slot beyond the last changes nothing."""
    absent = jnp.asarray(ABSENT_POSE, scene.poses.dtype)
    return SceneGraph(
        parents=scene.parents.at[slot].set(ROOT, mode="drop"),
        child_faces=scene.child_faces.at[slot].set(0, mode="drop"),
        parent_faces=scene.parent_faces.at[slot].set(0, mode="drop"),
        poses=scene.poses.at[slot].set(absent, mode="drop"),
        present=scene.present.at[slot].set(False, mode="drop"),
    )


def draw_pair(movable: jax.Array, uniform: jax.Array) -> jax.Array:
    """Two different slots of the movable (C,), or one and C for none; every unordered pair as likely.

    The state has no say in it.
    """
    size = len(movable)
    eligible = jnp.append(movable, True)
    first, second = jnp.triu_indices(size + 1, 1)
    pairs = (eligible[first] & eligible[second]).astype(uniform.dtype)
    drawn = draw_index(pairs, uniform)
    return jnp.stack([first[drawn], second[drawn]]).astype(jnp.int32)
