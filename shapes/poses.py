"""Rigid motions: jaxlie's SE(3) in kernels, 4x4 matrices between stages, `target_from_source` in names.

Quaternions are wxyz everywhere in voxscene; ROS, TUM and SciPy write xyzw, and the two functions here
are the only crossing. Tangent vectors put translation first, then rotation (jaxlie's order).
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recordings.poses.rigid import orthonormalised

__all__ = [
    "matrices_of",
    "orthonormalised",
    "pose_from_matrix",
    "poses_of",
    "wxyz_from_xyzw",
    "xyzw_from_wxyz",
]

Array = TypeVar("Array", jax.Array, NDArray[np.floating])


def wxyz_from_xyzw(xyzw: Array) -> Array:
    """Quaternions (..., 4) from the order of ROS, TUM and SciPy to ours."""
    return xyzw[..., [3, 0, 1, 2]]


def xyzw_from_wxyz(wxyz: Array) -> Array:
    """Quaternions (..., 4) from our order to that of ROS, TUM and SciPy."""
    return wxyz[..., [1, 2, 3, 0]]


def pose_from_matrix(matrix: jax.typing.ArrayLike) -> jaxlie.SE3:
    """Pose of a 4x4 rigid transform (..., 4, 4)."""
    return jaxlie.SE3.from_matrix(jnp.asarray(matrix))


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
