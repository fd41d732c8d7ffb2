"""Poses of kernels, wxyz_xyz float32, as 4x4 float64 matrices on the host, and back."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapes.poses import wxyz_from_xyzw, xyzw_from_wxyz


def matrices_of(poses: jax.Array | NDArray[np.floating]) -> NDArray[np.float64]:
    """(..., 4, 4) of poses (..., 7), rotations orthonormal to float64."""
    values = np.asarray(poses, np.float64)
    matrices = np.zeros((*values.shape[:-1], 4, 4))
    xyzw = xyzw_from_wxyz(values[..., :4]).reshape(-1, 4)
    matrices[..., :3, :3] = Rotation.from_quat(xyzw).as_matrix().reshape(*values.shape[:-1], 3, 3)
    matrices[..., :3, 3] = values[..., 4:]
    matrices[..., 3, 3] = 1.0
    return matrices


def poses_of(matrices: NDArray[np.float64]) -> jax.Array:
    """(..., 7) float32 of rigid transforms (..., 4, 4)."""
    leading = matrices.shape[:-2]
    xyzw = Rotation.from_matrix(matrices[..., :3, :3].reshape(-1, 3, 3)).as_quat()
    wxyz = wxyz_from_xyzw(xyzw).reshape(*leading, 4)
    return jnp.asarray(np.concatenate([wxyz, matrices[..., :3, 3]], axis=-1), jnp.float32)
