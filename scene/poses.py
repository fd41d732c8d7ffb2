"""Poses as arrays wxyz_xyz (7,), the way scene states hold them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


def pose_of(matrix: jax.Array) -> jax.Array:
    """The pose (7,) of a rigid transform (4, 4)."""
    return jaxlie.SE3.from_matrix(matrix).wxyz_xyz


def composed(first: jax.Array, second: jax.Array) -> jax.Array:
    """The pose a_from_c of a_from_b and b_from_c."""
    product = (jaxlie.SE3(first) @ jaxlie.SE3(second)).wxyz_xyz
    return jnp.concatenate([product[:4] / jnp.linalg.norm(product[:4]), product[4:]])


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
