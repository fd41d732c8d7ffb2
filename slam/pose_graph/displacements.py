"""Poses of keyframes and their displacements, in arrays of few sizes: each new one would be compiled."""

from __future__ import annotations

import jax
import numpy as np
from numpy.typing import NDArray

from shapes.geometry import pose_gaussian
from slam.filter.map_update import capacity_for


def displaced(poses: NDArray[np.float32], displacements: NDArray[np.float64]) -> NDArray[np.float32]:
    """Poses (N, 7) displaced by (N, 6)."""
    padded = _padded(poses, 0), _padded(displacements, 0)
    return np.asarray(_displaced(*padded))[: len(poses)]


def coordinates(origins: NDArray[np.float32], poses: NDArray[np.float32]) -> NDArray[np.float32]:
    """Coordinates (N, 6) of poses (N, 7) in the charts at others (N, 7)."""
    return np.asarray(_coordinates(_padded(origins, 0), _padded(poses, 0)))[: len(poses)]


def draw_poses(centres: NDArray[np.float32], displacements: NDArray[np.float64]) -> NDArray[np.float32]:
    """Poses (K, N, 7) displaced by (K, N, 6) from centres (N, 7)."""
    return np.asarray(_drawn(_padded(centres, 0), _padded(displacements, 1)))[:, : len(centres)]


def _padded(values: NDArray[np.floating], axis: int) -> NDArray[np.float32]:
    room = capacity_for(values.shape[axis]) - values.shape[axis]
    first = np.take(values, np.zeros(room, int), axis)
    return np.concatenate([values, first], axis).astype(np.float32)


_displaced = jax.jit(jax.vmap(pose_gaussian.displace))

_coordinates = jax.jit(jax.vmap(pose_gaussian.coordinates))

_drawn = jax.jit(jax.vmap(jax.vmap(pose_gaussian.displace), (None, 0)))
