"""Rays for expectation propagation, from the readings of every view.

Rays for each voxel footprint, view and surface: the voxels whose centres project into the footprint,
nearest first, of which those side by side have rays of their own. A ray is truncated to the voxels near its
surface, and may end before the first or go on beyond the last of them; voxels well before the surface are
crossed for sure but for unexplained readings, and get a site of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from shapes.learning.config import LearnConfig
from shapes.learning.expectation_propagation import SensorRays
from shapes.learning.view_readings import LEAST_ASSOCIATION, ViewReadings, band_m
from shapes.voxel_grid import VoxelGrid

ON_PLANE_SIGMAS = 2.5
"""1 in 80 pixels of a Normal is lost."""
SURFACES_APART_PITCHES = 2.0
"""Surfaces that a grid can tell apart."""
IN_SUCCESSION_PITCHES = 0.5
"""Of two voxels that stand less apart along a ray neither hides the other: they have rays of their own."""
LONGEST_RAY = 4
"""Voxels; few have more near their surface, and those are cut in parts."""
OBJECT_SIZE_M = 0.3
"""Extent over which an unexplained depth is uniform: that of a hand-held object."""
PEAK_DENSITY = 200.0
"""Of a reading where its surface is, per metre: what an unexplained reading competes with."""
LEAST_DENSITY = 1e-9
"""Per metre. Numerical guard: what contradicts readings that are explained for sure is impossible."""
RAY_BUCKET = 4096
"""Ray counts are rounded up to it, for fewer kernels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Evidence:
    """What all views say of N voxels.

    Attributes:
        rays: near surfaces.
        crossed: (N,) largest probability, over the views, that a ray went through and on.
        log_crossings: (N, C) log-likelihood of all such rays by the voxel's state.
        hidden: (N,) bool, behind a seen surface in some view.
    """

    rays: SensorRays
    crossed: NDArray[np.float64]
    log_crossings: NDArray[np.float64]
    hidden: NDArray[np.bool_]


def unexplained_density(config: LearnConfig) -> float:
    """Density per metre of a reading that no voxel explains: an outlier, or a surface without a voxel."""
    outlier = config.noise.outlier_probability / config.noise.max_range_m
    return max(config.unresolved / OBJECT_SIZE_M + outlier, LEAST_DENSITY)


def evidence(
    views: Sequence[ViewReadings],
    walls: NDArray[np.float64],
    grid: VoxelGrid,
    opacity: NDArray[np.float64],
    config: LearnConfig,
) -> Evidence:
    """Sort the readings of all views into crossings and rays.

    Args:
        views: their readings.
        walls: (N, 3) as `wall_normals` of them.
        grid: the voxels.
        opacity: (2, C) of a voxel's states for rays from before and from behind its wall.
        config: settings.
    """
    count = len(grid)
    crossed, hidden = np.zeros(count), np.zeros(count, np.bool_)
    log_crossings = np.zeros((count, opacity.shape[1]))
    crossings = np.zeros((2, count), np.int32)
    slip = unexplained_density(config) / PEAK_DENSITY
    places = []
    for number, view in enumerate(views):
        band = band_m(view.sigma_m, grid)
        side = _sides(view, walls, grid)
        measured = view.association > LEAST_ASSOCIATION
        crossed[view.crossed] = np.maximum(crossed[view.crossed], view.through)
        log_crossings[view.crossed] += np.log1p(
            -view.through[:, None] * opacity[side[view.crossed]] * (1 - slip)
        )
        before = np.unpackbits(view.before, count=count).view(np.bool_)
        for one in range(2):
            crossings[one] += before & (side == one)
        hidden |= np.unpackbits(view.hidden, count=count).view(np.bool_)
        for layer in range(view.behind_m.shape[1]):
            near = np.flatnonzero(measured[:, layer] & (np.abs(view.behind_m[:, layer]) <= band[:, layer]))
            places.append(_places(view, number, layer, near, side))
    log_crossings += crossings.T @ np.log1p(-opacity * (1 - slip))
    crossed[crossings.any(axis=0)] = 1.0
    fields = [np.concatenate(parts) for parts in zip(*places, strict=True)] if places else []
    return Evidence(
        rays=_assembled(fields, grid, config), crossed=crossed, log_crossings=log_crossings, hidden=hidden
    )


def _sides(view: ViewReadings, walls: NDArray[np.float64], grid: VoxelGrid) -> NDArray[np.int8]:
    """From which side of its wall the view sees each voxel (V,); 0 where no wall is near."""
    side = np.zeros(len(walls), np.int8)
    facing = np.flatnonzero(walls.any(axis=1))
    index = np.stack(np.unravel_index(facing, grid.shape), axis=1)
    direction = (index + 0.5) * grid.pitch_m - view.eye_m
    side[facing] = (direction * walls[facing]).sum(axis=1) > 0
    return side


def wall_normals(views: Sequence[ViewReadings], grid: VoxelGrid) -> NDArray[np.float64]:
    """Line (N, 3) along which the surfaces near each voxel face, from all views; of either sign."""
    near = [np.flatnonzero(view.normal.any(axis=1)) for view in views]
    faces = np.zeros(len(grid), np.bool_)
    for view, some in zip(views, near, strict=True):
        faces[view.voxel[some]] = True
    facing = np.flatnonzero(faces)
    place = np.zeros(len(grid), np.int32)
    place[facing] = np.arange(len(facing), dtype=np.int32)
    spread = np.zeros((len(facing), 3, 3))
    for view, some in zip(views, near, strict=True):
        spread[place[view.voxel[some]]] += view.normal[some, :, None] * view.normal[some, None, :]
    walls = np.zeros((len(grid), 3))
    walls[facing] = np.linalg.eigh(spread)[1][:, :, 2]
    return walls


def _places(
    view: ViewReadings, number: int, layer: int, near: NDArray[np.intp], side: NDArray[np.int8]
) -> tuple:
    """Voxel, distances, ray label (view, footprint column and row, on the plane) and side of readings."""
    behind, sigma = view.behind_m[near, layer], view.sigma_m[near, layer]
    surface = view.depth_m[near] - behind
    from_plane = surface - view.plane_depth_m[near]
    label = np.stack(
        [
            np.full(len(near), number),
            np.floor(view.column[near] / view.footprint).astype(np.int64),
            np.floor(view.row[near] / view.footprint).astype(np.int64),
            np.abs(from_plane) < ON_PLANE_SIGMAS * sigma,
        ],
        axis=1,
    )
    voxel = view.voxel[near]
    return voxel, behind, sigma, view.association[near, layer], surface, from_plane, label, side[voxel]


def _assembled(fields: list[NDArray], grid: VoxelGrid, config: LearnConfig) -> SensorRays:
    voxel, behind, sigma, association, surface, from_plane, label, side = fields
    ray = _surfaces(label, surface, SURFACES_APART_PITCHES * grid.pitch_m)
    ray = _successions(ray, behind, IN_SUCCESSION_PITCHES * grid.pitch_m)
    order = np.lexsort((behind, ray))
    voxel, behind, sigma, association, from_plane, ray, side = (
        field[order] for field in (voxel, behind, sigma, association, from_plane, ray, side)
    )
    first = np.diff(ray, prepend=-1) > 0
    first |= (np.arange(len(ray)) - np.flatnonzero(first)[np.cumsum(first) - 1]) % LONGEST_RAY == 0
    ray = np.cumsum(first) - 1
    starts, rays = np.flatnonzero(first), int(first.sum())
    last = np.append(starts, len(ray))[1:] - 1
    place = np.arange(len(ray)) - starts[ray]
    floor = unexplained_density(config)
    # the surface lies between the centre before, which is free, and this one; where in between is not
    # averaged over, since all views of the voxel share it
    step = np.where(first, grid.pitch_m, np.diff(behind, prepend=0.0))
    density = (ndtr(behind / sigma) - ndtr((behind - step) / sigma)) / grid.pitch_m + floor
    before = ndtr((behind[starts] - grid.pitch_m) / sigma[starts]) / grid.pitch_m
    on_plane = np.exp(-0.5 * np.minimum((from_plane / sigma) ** 2, 80.0)) / (sigma * np.sqrt(2 * np.pi))
    miss = np.bincount(ray, on_plane + floor, minlength=rays) / np.maximum(np.bincount(ray), 1)
    miss += ndtr(-behind[last] / sigma[last]) / grid.pitch_m
    largest = np.maximum(before, miss)
    np.maximum.at(largest, ray, density)
    shape = bucket(rays, RAY_BUCKET), LONGEST_RAY
    places = {
        "voxel": (voxel, len(grid), np.int32),
        "association": (association, 0.0, np.float32),
        "density": (density / largest[ray], 0.0, np.float32),
        "side": (side, 0, np.int32),
    }
    ends = {"before": (before / largest, 0.0), "miss": (miss / largest, 1.0)}
    table = {name: np.full(shape, fill, kind) for name, (_, fill, kind) in places.items()}
    table |= {name: np.full(shape[0], fill, np.float32) for name, (_, fill) in ends.items()}
    for name, (values, *_) in places.items():
        table[name][ray, place] = values
    for name, (values, _) in ends.items():
        table[name][:rays] = values
    return SensorRays(**{name: jnp.asarray(values) for name, values in table.items()})


def _surfaces(label: NDArray[np.int64], surface_m: NDArray[np.floating], apart_m: float) -> NDArray[np.int64]:
    """Number of the ray of each place: its label, split where readings jump from surface to surface."""
    group = np.unique(label, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.lexsort((surface_m, group))
    jump = (np.diff(group[order], prepend=-1) > 0) | (np.diff(surface_m[order], prepend=0.0) > apart_m)
    ray = np.empty(len(order), np.int64)
    ray[order] = np.cumsum(jump) - 1
    return ray


def _successions(ray: NDArray[np.int64], behind_m: NDArray[np.floating], apart_m: float) -> NDArray[np.int64]:
    """Number of the ray of each place (P,), split where voxels stand side by side on a surface.

    One voxel comes after another on a ray only if it lies so much farther behind the surface: each place
    takes the first ray of its bundle whose last place is that far before it.
    """
    order = np.lexsort((behind_m, ray))
    bundle, sizes = np.unique(ray, return_inverse=True, return_counts=True)[1:]
    bundle, behind = bundle.reshape(-1)[order], behind_m[order]
    starts = np.cumsum(sizes) - sizes
    most = int(sizes.max(initial=0))
    ends = np.full((len(sizes), most), -np.inf)
    lane = np.empty(len(order), np.int64)
    for number in range(most):
        open_ = np.flatnonzero(sizes > number)
        at = starts[open_] + number
        lane[at] = (ends[open_] <= behind[at, None] - apart_m).argmax(axis=1)
        ends[open_, lane[at]] = behind[at]
    split = np.empty(len(order), np.int64)
    split[order] = np.unique(bundle * most + lane, return_inverse=True)[1].reshape(-1)
    return split


def bucket(count: int, step: int) -> int:
    """The next of 1, 2, 3, 4, 6, 8, 12, 16, ... times `step`, so that few sizes are compiled."""
    size = step
    while size < count:
        size *= 2
    return size * 3 // 4 if size > 2 * step and size * 3 // 4 >= count else size
