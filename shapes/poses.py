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

from recordings.poses.rigid import orthonormalised

__all__ = ["orthonormalised", "pose_from_matrix", "wxyz_from_xyzw", "xyzw_from_wxyz"]

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
