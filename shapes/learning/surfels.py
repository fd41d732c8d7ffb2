"""Surfels from the readings of all views, and their distribution over particles distilled into one."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from shapes.learning.view_readings import ViewReadings
from shapes.learning.voxel_rays import ON_PLANE_SIGMAS
from shapes.surfels import SIDES, Surfels
from shapes.voxel_grid import VoxelGrid

ON_SURFACE = 0.5
"""A reading is of the surface that the ray is on with more than half of its probability."""
STEEPEST_COSINE = 0.25
"""Between a ray and the normal: planes steeper than 76 degrees are edges, as `STEEPEST_BELIEVED` has it."""
ALONG_WALL = 0.5
"""Cosine between a reading's normal and the wall's up to which it is of another face, as at an edge."""
LEVEL_COSINE = 0.9
"""Between a surface's normal and the support's: within 25 degrees it may be the support itself."""
HALF = 0.5
"""A surfel is there if the particles that have it weigh more."""
LEAST_SIGMA_M = 1e-6
"""Numerical guard of a difference of squares."""


def surfels(
    views: Sequence[ViewReadings], walls: NDArray[np.float64], grid: VoxelGrid, shared_sigma_m: float
) -> Surfels:
    """The posterior of the surface near every voxel, each side of the wall for itself.

    Readings of one side are Gaussian about its offset and independent between views but for an error that
    all share: the product of their densities, widened by that error once. Where they disagree by more than
    their deviations, as where the surface is no plane, it is widened by that. The normal is the mean over
    the voxel and its neighbours, for that of few pixels is off by tens of degrees.

    Args:
        views: their readings.
        walls: (V, 3) line along which the surfaces near each voxel face; zero where none is near.
        grid: the voxels.
        shared_sigma_m: standard deviation of the error that all views share.
    """
    if not views:
        return Surfels.none()
    parts = zip(*(_rows(view, grid) for view in views), strict=True)
    voxel, ray, behind, sigma, normal = (np.concatenate(part) for part in parts)
    smooth = _smoothed_normals(voxel, normal / sigma[:, None] ** 2, walls, grid)
    side = SIDES * voxel + ((normal * walls[voxel]).sum(axis=1) < 0)
    across = -(smooth[side] * ray).sum(axis=1)  # length along the normal for each unit of depth
    alike = (normal * smooth[side]).sum(axis=1) > ALONG_WALL
    steep = across < STEEPEST_COSINE * np.linalg.norm(ray, axis=1)
    chosen = alike & ~steep & (np.abs(behind) * across <= grid.pitch_m)
    offset, precision = (behind * across)[chosen], 1 / (sigma * across)[chosen] ** 2
    keys, place, counts = np.unique(side[chosen], return_inverse=True, return_counts=True)
    total = np.bincount(place, precision, minlength=len(keys))
    mean = np.bincount(place, precision * offset, minlength=len(keys)) / total
    misfit = np.bincount(place, precision * (offset - mean[place]) ** 2, minlength=len(keys))
    spread = np.maximum(misfit / np.maximum(counts - 1, 1), 1.0) / total
    return Surfels(
        voxel=(keys // SIDES).astype(np.int32),
        offset_m=mean.astype(np.float32),
        sigma_m=np.sqrt(spread + shared_sigma_m**2).astype(np.float32),
        normal=smooth[keys].astype(np.float32),
    )


def _rows(view: ViewReadings, grid: VoxelGrid) -> tuple[NDArray, ...]:
    """What one view reads of surfaces other than the support.

    Returns:
        Of R readings the voxel (R,), the ray to it (R, 3) for each unit of depth, how deep behind the surface
        it is (R,), with which deviation (R,), and the surface's normal (R, 3).
    """
    centres = (np.stack(np.unravel_index(view.voxel, grid.shape), axis=1) + 0.5) * grid.pitch_m
    ray = (centres - view.eye_m) / view.depth_m[:, None]
    normal = view.normal.astype(np.float64)
    found = []
    for behind, sigma, association in zip(view.behind_m.T, view.sigma_m.T, view.association.T, strict=True):
        from_plane = view.depth_m - behind - view.plane_depth_m
        support = (np.abs(from_plane) < ON_PLANE_SIGMAS * sigma) & (normal[:, 2] > LEVEL_COSINE)
        chosen = (association > ON_SURFACE) & normal.any(axis=1) & ~support
        values = view.voxel.astype(np.int64), ray, behind.astype(np.float64), sigma.astype(np.float64), normal
        found.append([one[chosen] for one in values])
    return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))


def _smoothed_normals(
    voxel: NDArray[np.int64], pull: NDArray[np.float64], walls: NDArray[np.float64], grid: VoxelGrid
) -> NDArray[np.float64]:
    """Unit normals (2 V, 3) of both sides of the wall at each voxel, zero where there is none.

    Args:
        voxel: (R,) of the readings.
        pull: (R, 3) their normals times their weights.
        walls: (V, 3) as of `surfels`.
        grid: the voxels.
    """
    index = np.stack(np.unravel_index(voxel, grid.shape), axis=1)
    length = np.linalg.norm(pull, axis=1)
    sums = np.zeros((SIDES * len(grid), 3))
    for step in itertools.product((-1, 0, 1), repeat=3):
        moved = index + step
        inside = np.all((moved >= 0) & (moved < grid.shape), axis=1)
        there = np.asarray(np.ravel_multi_index(tuple(moved[inside].T), grid.shape))
        facing = (pull[inside] * walls[there]).sum(axis=1) / length[inside]
        alike = np.abs(facing) > ALONG_WALL
        side = SIDES * there[alike] + (facing[alike] < 0)
        sums += _sums(side, pull[inside][alike], len(sums))
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30)


def distil_surfels(found: Sequence[Surfels], weights: NDArray[np.float64]) -> Surfels:
    """The surfels nearest to those of all particles, under their normalised weights (K,).

    The family is Bernoulli x Gaussian: there is a surfel, or none, and where it is. KL(p || q) is least at
    the mixture's moments: m* = sum w m and s*^2 = sum w (s^2 + m^2) - m*^2 over the particles that have one.
    """
    names = ("voxel", "offset_m", "sigma_m", "normal")
    rows = [np.concatenate([getattr(one, name) for one in found]).astype(np.float64) for name in names]
    voxel, offset, sigma, normal = rows
    particle = np.repeat(np.arange(len(found)), [len(one) for one in found])
    weight = weights[particle]
    first = np.unique(voxel, return_index=True)[1]
    group = np.searchsorted(voxel[first], voxel)
    across = normal.copy()  # less that of the other side, where there is one: at edges they are no opposites
    is_pair = (voxel[1:] == voxel[:-1]) & (particle[1:] == particle[:-1])
    across[:-1][is_pair] -= normal[1:][is_pair]
    facing = (normal * across[first][group]).sum(axis=1)
    keys, place = np.unique(SIDES * voxel.astype(np.int64) + (facing < 0), return_inverse=True)
    share = np.bincount(place, weight, minlength=len(keys))
    part = weight / share[place]
    mean = np.bincount(place, part * offset, minlength=len(keys))
    spread = np.bincount(place, part * (sigma**2 + (offset - mean[place]) ** 2), minlength=len(keys))
    facing = _sums(place, part[:, None] * normal, len(keys))
    distilled = Surfels(
        voxel=(keys // SIDES).astype(np.int32),
        offset_m=mean.astype(np.float32),
        sigma_m=np.sqrt(np.maximum(spread, LEAST_SIGMA_M**2)).astype(np.float32),
        normal=(facing / np.linalg.norm(facing, axis=1, keepdims=True)).astype(np.float32),
    )
    return distilled.part(share > HALF)


def _sums(place: NDArray[np.intp], vectors: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Sums (count, 3) of the vectors (R, 3) at each place."""
    sums = [np.bincount(place, vectors[:, axis], minlength=count) for axis in range(3)]
    return np.stack(sums, axis=1).astype(np.float64)
