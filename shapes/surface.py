"""Closed triangle surfaces of voxel probabilities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

SMALLEST_STEP = 0.02
"""Values are kept this far from the level: a value on it would give triangles without area."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceMesh:
    """A closed surface whose triangles wind counter-clockwise seen from outside.

    Attributes:
        vertices_m: (N, 3) float64 in the grid frame.
        triangles: (M, 3) int32 indices of vertices.
        inner, outer: (N, 3) indices of the voxels between whose centres each vertex lies, the occupied one
            first; the other may lie outside the grid.
        rgb: (N, 3) uint8 colour of each vertex, or None.
    """

    vertices_m: NDArray[np.float64]
    triangles: NDArray[np.int32]
    inner: NDArray[np.intp]
    outer: NDArray[np.intp]
    rgb: NDArray[np.uint8] | None = None


def level_surface(
    occupancy: NDArray[np.floating],
    level: float,
    pitch_m: float,
    rgb: NDArray[np.uint8] | None = None,
) -> SurfaceMesh:
    """Surface around the voxels whose probability exceeds `level`, by marching cubes (Lewiner 2003).

    The grid is surrounded by empty voxels, so the surface is closed where the object touches its edge.

    Args:
        occupancy: (I, J, K) probabilities; the centre of voxel (i, j, k) is at ((i, j, k) + 0.5) pitch.
        level: probability in (0, 1) that separates inside from outside.
        pitch_m: edge of a voxel.
        rgb: (I, J, K, 3) colours; a vertex takes that of the voxel inside next to it.

    Raises:
        ValueError: the level is not between 0 and 1, or no voxel lies above it.
    """
    if not 0 < level < 1:
        raise ValueError(f"the level of a surface lies between 0 and 1, got {level}")
    inside = occupancy > level
    if not inside.any():
        raise ValueError(f"no voxel is occupied with a probability above {level}: there is no surface")
    step = min(SMALLEST_STEP, 0.5 * level, 0.5 * (1 - level))
    field = np.where(inside, np.maximum(occupancy, level + step), np.minimum(occupancy, level - step))
    vertices, triangles, _, _ = marching_cubes(
        np.pad(field.astype(np.float32), 1), level, gradient_direction="ascent"
    )
    vertices = vertices.astype(np.float64) - 1.0  # back to voxel indices: centres at integers
    inner, outer = _voxels_beside(vertices, inside)
    return SurfaceMesh(
        vertices_m=(vertices + 0.5) * pitch_m,
        triangles=triangles.astype(np.int32),
        inner=inner,
        outer=outer,
        rgb=None if rgb is None else rgb[tuple(inner.T)],
    )


def _voxels_beside(
    vertices: NDArray[np.floating], inside: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The ends, inside and outside, of the lattice edge on which each vertex lies: indices (N, 3) each."""
    low, high = np.floor(vertices).astype(np.intp), np.ceil(vertices).astype(np.intp)
    begins_inside = np.pad(inside, 1)[tuple(low.T + 1)]
    inner = np.where(begins_inside[:, None], low, high)
    return inner, low + high - inner
