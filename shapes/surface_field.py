"""The field whose zero level is a shape's surface: by surfels where they are sure, by voxels elsewhere.

Voxels place a surface to a part of their size, and cannot hold a wall thinner than they are. Where surfels
are known to a quarter of a voxel the field is their signed distance instead: of a wall that of its nearer
side, on a lattice fine enough that the wall is in it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtri

from shapes.surfels import SIDES, Surfels

KNOWN_PITCHES = 0.25
"""Surfels of a smaller standard deviation say more than voxels, whose own is 0.29 of their edge."""
CONTRADICTION = 3.0
"""Standard deviations by which two sides must lie behind each other to bound a gap and not a wall."""
AGREEMENT = 2.0
"""Standard deviations within which a surfel may put its voxel's centre elsewhere than the voxel does."""
WALLED = 0.05
"""Share of a surface's voxels with walls thinner than a voxel from which on the lattice is finer."""
FINEST = 6
"""Steps of the lattice in a voxel: a hundred and fifty triangles for each voxel of a wall."""
THINNEST = 1.25
"""Steps of the lattice that a wall is thick at least: with one step slanting walls have pinholes."""
MOST_SAMPLES = 5e7
"""Of the lattice: 200 MB for each of two fields."""
COVERED = 0.5
"""Share of the voxels round a sample, by trilinear weight, whose surfels are known if they decide it."""
BACKED = 0.25
"""Share of these that know a wall's other side if it is drawn."""
CHUNK = 2**17
"""Samples at a time."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SurfaceField:
    """A field on a lattice that surrounds the grid by a voxel: sample u is at voxel index u / steps - 1.

    Attributes:
        values: (X, Y, Z) float32 positive inside, in voxels where it is a distance.
        sigma_m: (X, Y, Z) float32 standard deviation of the surface's place, +inf where voxels decide.
        steps: of the lattice, in a voxel.
        planes: the surfels that the field follows.
    """

    values: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    steps: int
    planes: KnownPlanes

    def settled(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vertices (N, 3) between samples, moved onto the surfels' surface by what samples err about it.

        Between the two sides of a wall the field is no plane; a vertex moves by less than a step.
        """
        found = vertices.copy()
        if not len(self.planes.voxel):
            return found
        for start in range(0, len(vertices), CHUNK):
            part = found[start : start + CHUNK]
            depth, _, normal, known = self.planes.at(part / self.steps, _thinnest(self.steps))
            move = np.clip(depth * self.steps, -1, 1)[:, None] * normal
            part[known] += move[known]
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownPlanes:
    """The known surfels of N voxels, at most two each; lengths in voxels.

    Attributes:
        voxel: (N,) places in the raveled grid.
        offset: (N, 2).
        sigma: (N, 2).
        normal: (N, 2, 3).
        known: (N, 2) bool.
        gap: (N,) bool, two walls face each other across free space.
        row_of: (I + 2, J + 2, K + 2) of each voxel, one round the grid too, -1 where none is known.
    """

    voxel: NDArray[np.intp]
    offset: NDArray[np.float32]
    sigma: NDArray[np.float32]
    normal: NDArray[np.float32]
    known: NDArray[np.bool_]
    gap: NDArray[np.bool_]
    row_of: NDArray[np.int32]

    def at(
        self, places: NDArray[np.floating], thinnest: float
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
        """The surface near places (M, 3), in voxel indices plus one.

        The planes of the eight voxels round a place are weighted trilinearly, the sides of a wall each for
        itself; which of its sides is the first is as in the voxel of most weight.

        Args:
            places: anywhere in the grid or the voxel round it.
            thinnest: walls are at least so thick.

        Returns:
            How deep inside they lie (M,), with which deviation (M,), the outward normal (M, 3), and which of
            them the planes decide (M,).
        """
        low = np.clip(np.floor(places).astype(np.intp), 0, np.asarray(self.row_of.shape) - 2)
        corners = np.array(list(itertools.product((0, 1), repeat=3)))
        row = self.row_of[tuple((low[:, None] + corners).transpose(2, 0, 1))]
        away = ((places - low)[:, None] - corners).astype(np.float32)  # from the centres, (M, 8, 3)
        weight = np.where(row >= 0, np.prod(1 - np.abs(away), axis=2), 0)
        main = np.take_along_axis(row, weight.argmax(axis=1)[:, None], axis=1)
        turned = (self.normal[row, 0] * self.normal[main, 0]).sum(axis=2) < 0
        sums = np.zeros((SIDES, len(places), 6), np.float32)
        for side in range(SIDES):
            which = np.where(turned, 1 - side, side)
            part = (weight * self.known[row, which])[..., None]
            normal = self.normal[row, which]
            depth = self.offset[row, which] - (normal * away).sum(axis=2)
            told = (depth[..., None], self.sigma[row, which][..., None], normal, np.ones_like(part))
            sums[side] = (part * np.concatenate(told, axis=2)).sum(axis=1)
        covered = weight.sum(axis=1)
        gap = (weight * self.gap[row]).sum(axis=1) > covered / 2
        share = sums[..., 5]
        told = sums[..., :5] / np.maximum(share, 1e-9)[..., None]
        missing = share < BACKED * covered
        thickness = np.where(missing.any(axis=0) | gap, np.inf, told[..., 0].sum(axis=0))
        told[..., 0] += np.maximum(thinnest - thickness, 0) / SIDES
        told[missing, 0] = np.inf
        deciding = told[..., 0].argmin(axis=0)
        deciding = np.where(gap & ~missing.any(axis=0), 1 - deciding, deciding)
        depth, sigma, *normal = told[deciding, np.arange(len(places))].T
        length = np.maximum(np.linalg.norm(normal, axis=0), 1e-9)
        return depth, sigma, (np.stack(normal) / length).T, covered >= COVERED


def surface_field(
    occupancy: NDArray[np.floating], level: float, surfels: Surfels, pitch_m: float
) -> SurfaceField:
    """The field of probabilities (I, J, K) at a level, and of the surfels beside them.

    A surfel's surface at that level is where a point is inside with that probability.
    """
    planes = _known_planes(occupancy, level, surfels, pitch_m)
    steps = _steps(planes, occupancy.shape)
    height = _finer(np.pad(occupancy.astype(np.float32), 1) - np.float32(level), steps)
    sigma = np.full_like(height, np.inf)
    samples = _samples_near(planes, occupancy.shape, steps)
    for start in range(0, len(samples), CHUNK):
        some = samples[start : start + CHUNK]
        depth, spread, _, known = planes.at(some / steps, _thinnest(steps))
        chosen = tuple(some[known].T)
        height[chosen], sigma[chosen] = depth[known], spread[known] * pitch_m
    return SurfaceField(values=height, sigma_m=sigma, steps=steps, planes=planes)


def _known_planes(
    occupancy: NDArray[np.floating], level: float, surfels: Surfels, pitch_m: float
) -> KnownPlanes:
    """Surfels that are sure, of those alone at their voxel only such that put its centre where it is."""
    sure = surfels.part(surfels.sigma_m < KNOWN_PITCHES * pitch_m)
    voxel, first, counts = np.unique(sure.voxel, return_index=True, return_counts=True)
    paired = counts == SIDES
    both = np.stack([first, first + paired], axis=1)
    offset, sigma = sure.offset_m[both], sure.sigma_m[both]
    gap = paired & (offset.sum(axis=1) < -CONTRADICTION * np.hypot(*sigma.T))
    offset = offset - sigma * float(ndtri(level))
    beneath = occupancy.ravel()[voxel] > level
    agrees = ((offset[:, 0] > 0) == beneath) | (np.abs(offset[:, 0]) < AGREEMENT * sigma[:, 0])
    kept = paired | agrees
    row_of = np.full(np.asarray(occupancy.shape) + 2, -1, np.int32)
    place = np.stack(np.unravel_index(voxel[kept], occupancy.shape)) + 1
    row_of[tuple(place)] = np.arange(kept.sum())
    return KnownPlanes(
        voxel=voxel[kept].astype(np.intp),
        offset=(offset / pitch_m)[kept].astype(np.float32),
        sigma=(sigma / pitch_m)[kept].astype(np.float32),
        normal=sure.normal[both][kept],
        known=np.stack([np.ones_like(paired), paired], axis=1)[kept],
        gap=gap[kept],
        row_of=row_of,
    )


def _finer(field: NDArray[np.float32], steps: int) -> NDArray[np.float32]:
    """Values between those of a field, trilinearly."""
    zoom = [((size - 1) * steps + 1) / size for size in field.shape]
    return np.asarray(ndimage.zoom(field, zoom, order=1), np.float32)


def _steps(planes: KnownPlanes, shape: tuple[int, ...]) -> int:
    """Steps in a voxel that half of the thin walls need, if there are such, as far as memory allows."""
    thickness = planes.offset.sum(axis=1)
    thin = planes.known.all(axis=1) & ~planes.gap & (thickness < 1)
    if thin.sum() <= WALLED * len(thin):
        return 1
    wanted = min(FINEST, np.ceil(THINNEST / max(float(np.median(thickness[thin])), 0.1)))
    allowed = (MOST_SAMPLES / np.prod(np.asarray(shape) + 2.0)) ** (1 / 3)
    return int(max(min(wanted, allowed), 1))


def _thinnest(steps: int) -> float:
    """Least thickness of walls, in voxels: what the lattice holds, where it was made for walls."""
    return THINNEST / steps if steps > 1 else 0.0


def _samples_near(planes: KnownPlanes, shape: tuple[int, ...], steps: int) -> NDArray[np.intp]:
    """The samples (M, 3) less than a voxel from the centre, along every axis, of a voxel with planes."""
    near = np.zeros([(size + 1) * steps + 1 for size in shape], np.bool_)
    centre = (np.stack(np.unravel_index(planes.voxel, shape), axis=1) + 1) * steps
    for move in itertools.product(range(1 - steps, steps), repeat=3):
        near[tuple((centre + move).T)] = True
    return np.argwhere(near)
