"""Poses for kernels, wxyz_xyz float32."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from shapes.poses import poses_of


def single_precision_poses(matrices: NDArray[np.float64]) -> jax.Array:
    """(..., 7) float32 of rigid transforms (..., 4, 4)."""
    return jnp.asarray(poses_of(matrices), jnp.float32)
