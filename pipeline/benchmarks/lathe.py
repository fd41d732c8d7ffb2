"""A mug turned on a lathe from NumPy alone, so that the speed of rendering can be measured anywhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

PROFILE_M = ((0, 0), (0.042, 0), (0.042, 0.092), (0.038, 0.092), (0.038, 0.006), (0, 0.006))
"""Radius and height round the mug's wall."""
HANDLE_M = (0.027, 0.006)
"""Radii of the handle's ring and of its cross section."""
SEGMENTS = 64


def mug() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (V, 3) in metres and triangles (F, 3) of a mug with a handle; the handle reaches inside."""
    wall, wall_faces = _turned(np.array(PROFILE_M, np.float64))
    angles = np.linspace(0, 2 * np.pi, 17)
    ring_m, tube_m = HANDLE_M
    ring, ring_faces = _turned(np.stack([ring_m + tube_m * np.cos(angles), tube_m * np.sin(angles)], axis=1))
    handle = ring[:, [0, 2, 1]] + [0.045, 0, 0.046]
    return np.concatenate([wall, handle]), np.concatenate([wall_faces, ring_faces + len(wall)])


def _turned(profile_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The surface that a curve (P, 2) of radius and height leaves when it turns round the z axis."""
    turns = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    radius, height = profile_m.T
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    vertices = np.empty((SEGMENTS, len(profile_m), 3))
    vertices[..., :2] = radius[None, :, None] * circle[:, None]
    vertices[..., 2] = height[None]
    index = np.arange(SEGMENTS * len(profile_m)).reshape(SEGMENTS, -1)
    a, b = index[:, :-1], index[:, 1:]
    d, c = np.roll(a, -1, axis=0), np.roll(b, -1, axis=0)
    return vertices.reshape(-1, 3), np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
