"""The contact chart: the pose of a child's face in the frame of its parent's face (supplement O.4).

Faces are numbered 2 axis + (sign > 0) of the bounding box. A face frame stands at the face's centre with
the outward normal as third axis. In

    X_child F(f) = X_parent F(f') [FLIP hopf(eta, phi), (a, b, z)],    FLIP = diag(1, -1, -1),

the flip puts flush contact at eta = (0, 0, 1), far from the chart's singular pole (docs/model.md, section O).
Poses are wxyz_xyz (7,) of objects whose frames are centred on their boxes.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from shapes.geometry.rotation_densities import hopf_coordinates, rotation_from_hopf

FACE_AXES = np.array([0, 0, 1, 1, 2, 2])

FACE_SIGNS = np.array([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0])

FACE_SPANS = (FACE_AXES[:, None] + np.array([1, 2])) % 3
"""(6, 2): the box axes along a face frame's first and second axis."""

TOP_FACE = 5

_FACE_WXYZ = np.array(
    [
        [-0.5, 0.5, 0.5, -0.5],
        [0.5, 0.5, 0.5, 0.5],
        [0.5, 0.5, -0.5, 0.5],
        [-0.5, 0.5, 0.5, 0.5],
        [0.0, 1.0, 0.0, 0.0],
        [1.0, 0.0, 0.0, 0.0],
    ]
)

_FLIP_WXYZ = np.array([0.0, 1.0, 0.0, 0.0])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Contact:
    """Continuous parameters of a contact.

    Attributes:
        offset_m: (3,) a, b, z: the child's face centre in the parent's face frame.
        eta: (3,) unit vector; the child's outward normal in that frame is FLIP eta, flush at (0, 0, 1).
        phi: spin about the normal in [0, 2 pi).
    """

    offset_m: jax.Array
    eta: jax.Array
    phi: jax.Array


def contact_from_poses(
    parent_pose: jax.Array,
    child_pose: jax.Array,
    parent_half_extents_m: jax.Array,
    child_half_extents_m: jax.Array,
    parent_face: jax.Array,
    child_face: jax.Array,
) -> Contact:
    """The contact of two faces of objects at given poses; half extents are (3,)."""
    parent = jaxlie.SE3(parent_pose) @ _face_frame(parent_half_extents_m, parent_face)
    child = jaxlie.SE3(child_pose) @ _face_frame(child_half_extents_m, child_face)
    relative = parent.inverse() @ child
    eta, phi = hopf_coordinates((_flip(child_pose) @ relative.rotation()).wxyz)
    return Contact(relative.translation(), eta, phi)


def pose_from_contact(
    contact: Contact,
    parent_pose: jax.Array,
    parent_half_extents_m: jax.Array,
    child_half_extents_m: jax.Array,
    parent_face: jax.Array,
    child_face: jax.Array,
) -> jax.Array:
    """The child's pose (7,) with a given contact, the inverse of `contact_from_poses`."""
    rotation = _flip(parent_pose) @ jaxlie.SO3(rotation_from_hopf(contact.eta, contact.phi))
    relative = jaxlie.SE3.from_rotation_and_translation(rotation, contact.offset_m)
    parent = jaxlie.SE3(parent_pose) @ _face_frame(parent_half_extents_m, parent_face)
    return (parent @ relative @ _face_frame(child_half_extents_m, child_face).inverse()).wxyz_xyz


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RelativeBox:
    """A child seen from its parent's box frame: the part of a contact that densities need.

    Attributes:
        axes: (3, 3), the child's box axes as columns.
        centre_m: (3,) the child's centre.
    """

    axes: jax.Array
    centre_m: jax.Array


def relative_box(parent_pose: jax.Array, child_pose: jax.Array) -> RelativeBox:
    """One child seen from one parent, poses (7,)."""
    parent, child = _rotation_matrix(parent_pose[:4]), _rotation_matrix(child_pose[:4])
    offset = child_pose[4:] - parent_pose[4:]
    axes = jnp.sum(parent[:, :, None] * child[:, None, :], axis=0)
    return RelativeBox(axes, jnp.sum(parent * offset[:, None], axis=0))


def face_contact(
    box: RelativeBox,
    parent_half_extents_m: jax.Array,
    child_half_extents_m: jax.Array,
    parent_face: jax.Array,
    child_face: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Whether (a, b) lies on the parent's face, the gap z, and eta's third component."""
    along, sign = _axis_and_sign(parent_face, child_half_extents_m.dtype)
    child_along, child_sign = _axis_and_sign(child_face, child_half_extents_m.dtype)
    normal = child_sign * jnp.sum(box.axes * child_along[None, :], axis=1)
    face_centre = box.centre_m + normal * jnp.sum(child_half_extents_m * child_along)
    on_face = jnp.all((jnp.abs(face_centre) <= parent_half_extents_m) | (along > 0))
    gap = jnp.sum((sign * face_centre - parent_half_extents_m) * along)
    return on_face, gap, -sign * jnp.sum(normal * along)


def face_half_sizes(half_extents_m: jax.Array, face: jax.Array) -> jax.Array:
    """Half sizes (2,) of a face along its frame's first two axes."""
    return half_extents_m[jnp.asarray(FACE_SPANS)[face]]


def _axis_and_sign(face: jax.Array, dtype: jnp.dtype) -> tuple[jax.Array, jax.Array]:
    """One-hot axis (3,) and sign of a face; without look-ups, which vectorise badly."""
    return (jnp.arange(3) == face >> 1).astype(dtype), (2 * (face & 1) - 1).astype(dtype)


def upward_part(wxyz: jax.Array) -> jax.Array:
    """Of each axis of an object, the third row (..., 3) of its rotations wxyz (..., 4)."""
    w, x, y, z = jnp.moveaxis(wxyz, -1, 0)
    return jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def _rotation_matrix(wxyz: jax.Array) -> jax.Array:
    w, x, y, z = wxyz
    return jnp.stack(
        [
            jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]),
            jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]),
            upward_part(wxyz),
        ]
    )


def _face_frame(half_extents_m: jax.Array, face: jax.Array) -> jaxlie.SE3:
    axes = jnp.asarray(FACE_AXES)[face]
    sign = jnp.asarray(FACE_SIGNS, half_extents_m.dtype)[face]
    centre = jnp.where(jnp.arange(3) == axes, sign * half_extents_m, 0.0)
    rotation = jaxlie.SO3(jnp.asarray(_FACE_WXYZ, half_extents_m.dtype)[face])
    return jaxlie.SE3.from_rotation_and_translation(rotation, centre)


def _flip(like: jax.Array) -> jaxlie.SO3:
    return jaxlie.SO3(jnp.asarray(_FLIP_WXYZ, like.dtype))
