"""Rigid motions: jaxlie's SE(3) in kernels, 4x4 matrices between stages, `target_from_source` in names.

Quaternions are wxyz everywhere in voxscene; ROS, TUM and SciPy write xyzw, and the two functions here are the
only conversion. Kernels hold poses as arrays wxyz_xyz (7,). Tangent vectors put translation first, then
rotation (jaxlie's order).
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapes.geometry.vectors import transform

Array = TypeVar("Array", jax.Array, NDArray[np.floating])


def wxyz_from_xyzw(xyzw: Array) -> Array:
    """Quaternions (..., 4) from the order of ROS, TUM and SciPy to ours."""
    return xyzw[..., [3, 0, 1, 2]]


def xyzw_from_wxyz(wxyz: Array) -> Array:
    """Quaternions (..., 4) from our order to that of ROS, TUM and SciPy."""
    return wxyz[..., [1, 2, 3, 0]]


def matrices_of(poses: jax.Array | NDArray[np.floating]) -> NDArray[np.float64]:
    """Rigid transforms (..., 4, 4) of poses (..., 7) wxyz_xyz, on the host, orthonormal to float64."""
    values = np.asarray(poses, np.float64)
    matrices = np.zeros((*values.shape[:-1], 4, 4))
    xyzw = xyzw_from_wxyz(values[..., :4]).reshape(-1, 4)
    matrices[..., :3, :3] = Rotation.from_quat(xyzw).as_matrix().reshape(*values.shape[:-1], 3, 3)
    matrices[..., :3, 3] = values[..., 4:]
    matrices[..., 3, 3] = 1.0
    return matrices


def poses_of(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (..., 7) wxyz_xyz of rigid transforms (..., 4, 4), on the host."""
    xyzw = Rotation.from_matrix(matrices[..., :3, :3].reshape(-1, 3, 3)).as_quat()
    wxyz = wxyz_from_xyzw(xyzw).reshape(*matrices.shape[:-2], 4)
    return np.concatenate([wxyz, matrices[..., :3, 3]], axis=-1)


def pose_of(matrix: jax.Array) -> jax.Array:
    """The pose (7,) of a rigid transform (4, 4)."""
    return jaxlie.SE3.from_matrix(matrix).wxyz_xyz


def compose(first: jax.Array, second: jax.Array) -> jax.Array:
    """The pose a_from_c of a_from_b and b_from_c."""
    product = (jaxlie.SE3(first) @ jaxlie.SE3(second)).wxyz_xyz
    return jnp.concatenate([product[:4] / jnp.linalg.norm(product[:4]), product[4:]])


def transform_points(
    target_from_source: NDArray[np.floating], points: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Points (..., 3) of a source where a rigid transform (4, 4) puts them, on the host."""
    return points @ target_from_source[:3, :3].T + target_from_source[:3, 3]


def placed_points(matrices: NDArray[np.floating], points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Points (S, P, 3) of a source (P, 3) where each of rigid transforms (S, 4, 4) puts them, on the host."""
    return points @ np.swapaxes(matrices[:, :3, :3], 1, 2) + matrices[:, None, :3, 3]


def transformed(pose: jax.Array, points: jax.Array) -> jax.Array:
    """Points (3, ...) of a source where target_from_source (7,) puts them."""
    motion = jaxlie.SE3(pose)
    return transform(motion.rotation().as_matrix(), motion.translation(), points)


@jax.jit
def relative_pose(origin: jax.typing.ArrayLike, pose: jax.typing.ArrayLike) -> jax.Array:
    """The pose (7,) b_from_c of a_from_b and a_from_c."""
    return (jaxlie.SE3(jnp.asarray(origin)).inverse() @ jaxlie.SE3(jnp.asarray(pose))).wxyz_xyz


def tangents_of(matrices: NDArray[np.floating]) -> NDArray[np.float64]:
    """Logarithms (..., 6) of rigid transforms (..., 4, 4), translation first as in jaxlie, on the host."""
    turns = Rotation.from_matrix(matrices[..., :3, :3].reshape(-1, 3, 3)).as_rotvec()
    turns = turns.reshape(*matrices.shape[:-2], 3)
    half = np.maximum(np.linalg.norm(turns, axis=-1, keepdims=True), 1e-6) / 2
    across = np.cross(turns, matrices[..., :3, 3])
    bend = (1 - half / np.tan(half)) / (4 * half**2)
    return np.concatenate(
        [matrices[..., :3, 3] - across / 2 + bend * np.cross(turns, across), turns], axis=-1
    )


def motions_of(tangents: NDArray[np.floating]) -> NDArray[np.float64]:
    """Rigid transforms (..., 4, 4) with these logarithms (..., 6), the inverse of `tangents_of`."""
    offsets, turns = tangents[..., :3], tangents[..., 3:]
    angle = np.maximum(np.linalg.norm(turns, axis=-1, keepdims=True), 1e-6)
    across = np.cross(turns, offsets)
    bend = (1 - np.sinc(angle / np.pi)) / angle**2
    matrices = np.zeros((*tangents.shape[:-1], 4, 4))
    rotations = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix()
    matrices[..., :3, :3] = rotations.reshape(*tangents.shape[:-1], 3, 3)
    swept = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * across
    matrices[..., :3, 3] = offsets + swept + bend * np.cross(turns, across)
    matrices[..., 3, 3] = 1
    return matrices


def single_precision_poses(matrices: NDArray[np.float64]) -> jax.Array:
    """(..., 7) float32 of rigid transforms (..., 4, 4)."""
    return jnp.asarray(poses_of(matrices), jnp.float32)
