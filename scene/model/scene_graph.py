"""A scene graph as fixed-capacity arrays: who rests on whom, by which faces, and where everything is.

The state keeps absolute poses. The parameters theta of supplement O (a pose for a floating object, a
contact for a supported one) are the image of this state under the chart of `scene.model.contact`, which is a
bijection for every graph; densities are those of theta. A structure move therefore leaves the poses
alone, bit for bit, and an error of the chart never accumulates.

Object frames are centred on the object's bounding box, so that a box is its half extents.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

ROOT = -1
"""Parent of a floating object."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Bodies:
    """What is known of the C objects and does not change: boxes and roles.

    Attributes:
        half_extents_m: (C, 3) of the bounding boxes.
        movable: (C,) bool; the support plane ("table") is not movable and always a child of the root.
        supporting_faces: (C, 6) bool, the faces on which others may rest.
    """

    half_extents_m: jax.Array
    movable: jax.Array
    supporting_faces: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SceneGraph:
    """A tree over the present objects and the root, with the pose of every object.

    Attributes:
        parents: (C,) int32, `ROOT` for floating and absent objects.
        child_faces: (C,) int32, the object's own face in its contact; 0 where floating.
        parent_faces: (C,) int32, the parent's face in that contact; 0 where floating.
        poses: (C, 7) world_from_object, wxyz and xyz.
        present: (C,) bool.
    """

    parents: jax.Array
    child_faces: jax.Array
    parent_faces: jax.Array
    poses: jax.Array
    present: jax.Array


def floating_scene(poses: jax.Array, present: jax.Array | None = None) -> SceneGraph:
    """The graph G_0 without edges between objects, at world_from_object `poses` (C, 7)."""
    count = len(poses)
    none = jnp.zeros(count, jnp.int32)
    present = jnp.ones(count, bool) if present is None else present
    return SceneGraph(jnp.full(count, ROOT, jnp.int32), none, none, poses, present)


def subtree(parents: jax.Array, top: jax.Array) -> jax.Array:
    """Mask (C,) of `top` and its descendants."""
    nodes = jnp.arange(len(parents))
    inside = nodes == top
    for _ in range(len(parents) - 1):
        inside = inside | (inside[parents] & (parents != ROOT))
    return inside


def all_trees(free: int, *, table: bool = False) -> NDArray[np.int32]:
    """Parents (T, C) of every tree over `free` objects and the root, the last of C the table if there is one.

    T is (N+1)^(N-1), with the table 2 (N+2)^(N-1) (supplement, proposition O.2.1; docs/model.md, section O).
    """
    count = free + table
    choices = np.array(np.meshgrid(*[np.arange(ROOT, count)] * free, indexing="ij")).reshape(free, -1).T
    parents = np.concatenate([choices, np.full((len(choices), int(table)), ROOT)], axis=1)
    reached = parents
    for _ in range(count):
        reached = np.where(reached == ROOT, ROOT, np.take_along_axis(parents, reached, axis=1))
    return parents[(reached == ROOT).all(axis=1)].astype(np.int32)


def tree_code(parents: jax.Array) -> jax.Array:
    """A number that tells trees of one capacity apart: the parents (C,) as digits to the base C + 1."""
    count = len(parents)
    return jnp.sum((parents + 1) * (count + 1) ** jnp.arange(count), dtype=jnp.int32)
