"""Closed triangle surfaces of voxel probabilities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes

from shapes.surface_field import surface_field
from shapes.surfels import Surfels

SMALLEST_STEP = 0.02
"""Values are kept this far from the level: a value on it would give triangles without area."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceMesh:
    """A closed surface whose triangles wind counter-clockwise seen from outside.

    Attributes:
        vertices_m: (N, 3) float64 in the grid frame.
        triangles: (M, 3) int32 indices of vertices.
        inner, outer: (N, 3) indices of the voxels between whose centres each vertex lies, the occupied one
            first; the other may lie outside the grid. On a lattice finer than the voxels, those at its
            samples, which may be one voxel.
        sigma_m: (N,) standard deviation of each vertex along the normal, +inf where only voxels place it.
        rgb: (N, 3) uint8 colour of each vertex, or None.
    """

    vertices_m: NDArray[np.float64]
    triangles: NDArray[np.int32]
    inner: NDArray[np.intp]
    outer: NDArray[np.intp]
    sigma_m: NDArray[np.float32]
    rgb: NDArray[np.uint8] | None = None


def level_surface(
    occupancy: NDArray[np.floating],
    level: float,
    pitch_m: float,
    rgb: NDArray[np.uint8] | None = None,
    surfels: Surfels | None = None,
) -> SurfaceMesh:
    """Surface around the voxels whose probability exceeds `level`, by marching cubes (Lewiner 2003).

    The grid is surrounded by empty voxels, so the surface is closed where the object touches its edge.

    Args:
        occupancy: (I, J, K) probabilities; the centre of voxel (i, j, k) is at ((i, j, k) + 0.5) pitch.
        level: probability in (0, 1) that separates inside from outside.
        pitch_m: edge of a voxel.
        rgb: (I, J, K, 3) colours; a vertex takes that of the voxel inside next to it.
        surfels: of the grid; where they are sure they place the surface.

    Raises:
        ValueError: the level is not between 0 and 1, or no voxel lies above it.
    """
    if not 0 < level < 1:
        raise ValueError(f"the level of a surface lies between 0 and 1, got {level}")
    found = surface_field(occupancy, level, surfels or Surfels.none(), pitch_m)
    inside = _without_specks(found.values > 0, found.steps)
    if not inside.any():
        raise ValueError(f"no voxel is occupied with a probability above {level}: there is no surface")
    step = min(SMALLEST_STEP, 0.5 * level, 0.5 * (1 - level)) / found.steps
    field = np.where(inside, np.maximum(found.values, step), np.minimum(found.values, -step))
    vertices, triangles, _, _ = marching_cubes(field, 0.0, gradient_direction="ascent")
    vertices = vertices.astype(np.float64)
    first, second = _samples_beside(vertices, inside)
    size = np.asarray(occupancy.shape)
    outer = np.rint(second / found.steps).astype(np.intp) - 1
    inner = np.clip(np.rint(first / found.steps).astype(np.intp) - 1, 0, size - 1)
    return SurfaceMesh(
        vertices_m=(found.settled(vertices) / found.steps - 0.5) * pitch_m,
        triangles=triangles.astype(np.int32),
        inner=inner,
        outer=outer,
        sigma_m=np.maximum(found.sigma_m[tuple(first.T)], found.sigma_m[tuple(second.T)]),
        rgb=None if rgb is None else rgb[tuple(inner.T)],
    )


def _without_specks(inside: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """The samples inside (X, Y, Z) without pieces, and with holes filled, that are smaller than a voxel."""
    for _ in range(2):
        label = np.zeros(inside.shape, np.int32)
        ndimage.label(inside, np.ones((3, 3, 3)), output=label)
        inside = ~(inside & (np.bincount(label.ravel())[label] >= steps**3))
    return inside


def _samples_beside(
    vertices: NDArray[np.floating], inside: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The ends, inside and outside, of the lattice edge on which each vertex lies: indices (N, 3) each."""
    low, high = np.floor(vertices).astype(np.intp), np.ceil(vertices).astype(np.intp)
    first = np.where(inside[tuple(low.T)][:, None], low, high)
    return first, low + high - first
