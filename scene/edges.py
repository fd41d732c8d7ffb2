"""An object's edge as a place in a table: the root first, then every parent with each pair of faces."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from scene.graph import ROOT, SceneGraph
from scene.model import SceneModel
from scene.prior import contact_densities, log_floating
from scene.rotation_densities import LOG_CONTACT_JACOBIAN

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
