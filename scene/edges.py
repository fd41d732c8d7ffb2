"""An object's edge as a place in a table: the root first, then every parent with each pair of faces."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from scene.graph import ROOT, SceneGraph

_FACE_PAIRS = 36


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
