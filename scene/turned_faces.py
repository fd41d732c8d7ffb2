"""Contacts that outlive a turn: faces are named by where they point while the object is placed anew.

A box turned upside down rests on its other face: with the old name of the face its contact would be
impossible, and no chain would ever turn it. A reference orientation and the nearest of a cube's 24
rotations to the turn from it tell which face points where. Names given so are a bijection for every pose,
and do not depend on the pose that was left, so that they compose: the density of the renamed scene is that
of the same state in other names, without a Jacobian.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from scene import quaternions
from scene.contact import FACE_AXES, FACE_SIGNS
from scene.graph import ROOT, SceneGraph
from scene.orientations import cube_rotations

_TURNS_WXYZ = Rotation.from_matrix(cube_rotations()).as_quat()[:, [3, 0, 1, 2]]
_NORMALS = np.eye(3)[FACE_AXES] * FACE_SIGNS[:, None]
_POINTS_AS = np.einsum("fi,kij,gj->kfg", _NORMALS, cube_rotations(), _NORMALS).argmax(axis=1)
"""(24, 6): the face that points in the reference where a face points after a turn."""
_FACE_THERE = np.argsort(_POINTS_AS, axis=1)
"""Its inverse: the face that points, after a turn, where a face points in the reference."""


def placed(scene: SceneGraph, chosen: jax.Array, reference: jax.Array, pose: jax.Array) -> SceneGraph:
    """The scene with one object at another pose, everything else in its place, contacts where they point.

    Args:
        scene: as it is.
        chosen: the object.
        reference: wxyz (4,) an orientation of the object that does not depend on the scene.
        pose: (7,).
    """
    names = jnp.asarray(_FACE_THERE)[_turn(reference, pose[:4])][
        jnp.asarray(_POINTS_AS)[_turn(reference, scene.poses[chosen, :4])]
    ].astype(scene.child_faces.dtype)
    own = jnp.where(
        scene.parents[chosen] == ROOT, scene.child_faces[chosen], names[scene.child_faces[chosen]]
    )
    return replace(
        scene,
        poses=scene.poses.at[chosen].set(pose),
        child_faces=scene.child_faces.at[chosen].set(own),
        parent_faces=jnp.where(scene.parents == chosen, names[scene.parent_faces], scene.parent_faces),
    )


def _turn(reference: jax.Array, wxyz: jax.Array) -> jax.Array:
    """Which of the cube's rotations is nearest to the turn from the reference."""
    relative = quaternions.times(quaternions.inverse(reference), wxyz)
    return jnp.argmax(jnp.abs(jnp.sum(_TURNS_WXYZ * relative[None], axis=1)))
