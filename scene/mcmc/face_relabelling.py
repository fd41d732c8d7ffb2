"""Relabels box faces when an object is rotated, so that its contacts keep the faces that touch.

A box turned upside down rests on its other face: under the old label its contact would be impossible, and no
chain would ever turn it. A reference orientation and the nearest of a cube's 24 rotations to the rotation
from it tell which face points where. These labels are a bijection for every pose and do not depend on the
pose that was left, so that they compose: the density of the relabelled scene is that of the same state,
without a Jacobian.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from scene.model.contact import FACE_AXES, FACE_SIGNS
from scene.model.scene_graph import ROOT, SceneGraph
from scene.objects.orientations import cube_rotations
from shapes.geometry import quaternions

_TURNS_WXYZ = Rotation.from_matrix(cube_rotations()).as_quat()[:, [3, 0, 1, 2]]

_NORMALS = np.eye(3)[FACE_AXES] * FACE_SIGNS[:, None]

_POINTS_AS = np.einsum("fi,kij,gj->kfg", _NORMALS, cube_rotations(), _NORMALS).argmax(axis=1)
"""(24, 6): the face that points in the reference where a face points after a turn."""

_FACE_THERE = np.argsort(_POINTS_AS, axis=1)
"""Its inverse: the face that points, after a turn, where a face points in the reference."""


def at_reference(scene: SceneGraph, chosen: jax.Array, reference: jax.Array) -> SceneGraph:
    """The scene with one object at a reference pose (7,) that does not depend on it, for `placed`."""
    names = jnp.asarray(_POINTS_AS)[_turn(reference, scene.poses[chosen])]
    return _renamed(scene, chosen, reference, names)


def placed(scene: SceneGraph, chosen: jax.Array, pose: jax.Array) -> SceneGraph:
    """The scene with one object at another pose, everything else in its place, contacts where they point.

    Args:
        scene: `at_reference`.
        chosen: the object.
        pose: (7,).
    """
    names = jnp.asarray(_FACE_THERE)[_turn(scene.poses[chosen], pose)]
    return _renamed(scene, chosen, pose, names)


def _renamed(scene: SceneGraph, chosen: jax.Array, pose: jax.Array, names: jax.Array) -> SceneGraph:
    """The scene with one object at another pose (7,) and new names (6,) of its faces."""
    names = names.astype(scene.child_faces.dtype)
    own = scene.child_faces[chosen]
    own = jnp.where(scene.parents[chosen] == ROOT, own, names[own])
    return replace(
        scene,
        poses=scene.poses.at[chosen].set(pose),
        child_faces=scene.child_faces.at[chosen].set(own),
        parent_faces=jnp.where(scene.parents == chosen, names[scene.parent_faces], scene.parent_faces),
    )


def _turn(reference: jax.Array, pose: jax.Array) -> jax.Array:
    """Which of the cube's rotations is nearest to the turn from the reference (7,)."""
    relative = quaternions.multiply(quaternions.inverse(reference[:4]), pose[:4])
    alike = jnp.abs(jnp.sum(_TURNS_WXYZ * relative[None], axis=1))
    return jnp.max(jnp.where(alike == jnp.max(alike), np.arange(len(_TURNS_WXYZ)), 0))
