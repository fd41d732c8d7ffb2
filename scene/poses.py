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


def matrices_of(poses: NDArray[np.floating]) -> NDArray[np.float64]:
    """Rigid transforms (..., 4, 4) of poses (..., 7), on the host."""
    matrices = np.zeros((*poses.shape[:-1], 4, 4))
    turns = Rotation.from_quat(np.asarray(poses, np.float64)[..., :4].reshape(-1, 4), scalar_first=True)
    matrices[..., :3, :3] = turns.as_matrix().reshape(*poses.shape[:-1], 3, 3)
    matrices[..., :3, 3] = poses[..., 4:]
    matrices[..., 3, 3] = 1
    return matrices
