"""Poses of keyframes and their displacements, a fixed number at once: each new one would be compiled."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from shapes.geometry import pose_gaussian
from shapes.geometry.poses import relative_pose

AT_ONCE = 64
"""Rows for which kernels are compiled."""


def in_parts(kernel: Callable[..., Any], *arrays: NDArray[np.floating]) -> Any:
    """A kernel over rows (n, ...) of arrays, on `AT_ONCE` of them at once; on the host, single precision."""
    count, parts = len(arrays[0]), []
    for first in range(0, count, AT_ONCE):
        rows = np.minimum(np.arange(first, first + AT_ONCE), count - 1)
        found = kernel(*(array[rows].astype(np.float32) for array in arrays))
        parts.append(jax.tree.map(lambda leaf, known=count - first: np.asarray(leaf)[:known], found))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


displaced = partial(in_parts, jax.jit(jax.vmap(pose_gaussian.displace)))
"""Poses (N, 7) displaced by (N, 6)."""

coordinates = partial(in_parts, jax.jit(jax.vmap(pose_gaussian.coordinates)))
"""Coordinates (N, 6) of poses (N, 7), which come second, in the charts at others (N, 7)."""

relative_poses = partial(in_parts, jax.jit(jax.vmap(relative_pose)))
"""origin_from_pose (N, 7) of origins (N, 7) and poses (N, 7)."""

_drawn = jax.jit(jax.vmap(jax.vmap(pose_gaussian.displace, (None, 0))))


def draw_poses(centres: NDArray[np.float32], displacements: NDArray[np.float64]) -> NDArray[np.float32]:
    """Poses (K, N, 7) displaced by (K, N, 6) from centres (N, 7)."""
    return in_parts(_drawn, centres, displacements.swapaxes(0, 1)).swapaxes(0, 1)
