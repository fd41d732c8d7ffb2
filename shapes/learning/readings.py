"""Readings of one depth image at each voxel centre: signed distance to the surface along the ray.

Between four pixels that see two surfaces, the ray sees the nearer one or the farther one; both readings
are kept, each with the probability that the ray is on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from shapes.geometry.camera import Camera, project
from shapes.learning.local_planes import LocalPlanes

SPLIT_SIGMAS = 3.0
"""Three sigma: depths farther apart are two surfaces."""
SPLIT_M = 0.002
"""Readings of neighbouring pixels that differ by more than both are of two surfaces."""
OVERLAP = 0.6
"""Share of the pixels that two neighbours' planes have in common: correlation of their errors."""
NEAREST_M = 1e-3
"""Numerical guard."""
UNMEASURED = 0.5
"""Share of the neighbours without a return that counts as seeing what the others see."""


NOTHING, BEFORE, BEHIND, NEAR = range(4)
"""What a first look says of a voxel: no reading, well before or behind every surface there, or near one."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Readings:
    """Readings of N voxels; the second axis is the nearer and the farther surface.

    Attributes:
        behind_m: (N, 2) depth of the voxel's centre minus that of the surface; positive where hidden.
        sigma_m: (N, 2) standard deviation of `behind_m`.
        association: (N, 2) probability that the ray is on that surface; 0 where there is no reading.
        column: (N,) image coordinates of the centre.
        row: (N,).
        depth_m: (N,) of the centre.
    """

    behind_m: jax.Array
    sigma_m: jax.Array
    association: jax.Array
    column: jax.Array
    row: jax.Array
    depth_m: jax.Array


@jax.jit
def initial_readings(
    planes: LocalPlanes,
    camera: Camera,
    corner: jax.Array,
    camera_from_grid: jax.Array,
    centres_m: jax.Array,
    margin_m: jax.Array | float,
) -> jax.Array:
    """Which voxel centres (N, 3) need a reading in one view, and where the others stand: (N,) int8.

    Well before or behind means by more than the margin, with a return at each of the four pixels around.
    Arguments as those of `voxel_readings`.
    """
    column, row, depth = _projected(camera, camera_from_grid, centres_m)
    left, top = jnp.floor(column - corner[0]), jnp.floor(row - corner[1])
    height, width = planes.valid.shape
    returned, nearest, farthest = [], jnp.inf, -jnp.inf
    for dv, du in ((0, 0), (0, 1), (1, 0), (1, 1)):
        u, v = left + du, top + dv
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (depth > NEAREST_M)
        index = jnp.clip(v, 0, height - 1).astype(jnp.int32), jnp.clip(u, 0, width - 1).astype(jnp.int32)
        returned.append(inside & planes.valid[index])
        behind = depth - 1.0 / jnp.maximum(planes.inverse_depth[index], 1e-3)
        nearest, farthest = jnp.minimum(nearest, behind), jnp.maximum(farthest, behind)
    some, all_ = jnp.any(jnp.stack(returned), axis=0), jnp.all(jnp.stack(returned), axis=0)
    plain = jnp.where(farthest < -margin_m, BEFORE, jnp.where(nearest > margin_m, BEHIND, NEAR))
    return jnp.where(all_, plain, jnp.where(some, NEAR, NOTHING)).astype(jnp.int8)


@jax.jit
def voxel_readings(
    planes: LocalPlanes,
    camera: Camera,
    corner: jax.Array,
    camera_from_grid: jax.Array,
    centres_m: jax.Array,
    registration_sigma_m: jax.Array | float,
) -> Readings:
    """Readings of voxel centres (N, 3) in one view.

    Args:
        planes: of the view, or of a window cut out of it.
        camera: of the whole view.
        corner: (2,) column and row of the window's first pixel.
        camera_from_grid: (4, 4).
        centres_m: in the grid frame.
        registration_sigma_m: standard deviation of the view's registration along its rays.
    """
    column, row, depth = _projected(camera, camera_from_grid, centres_m)
    neighbours = [
        _neighbour(planes, column - corner[0], row - corner[1], dv, du) for dv in (0, 1) for du in (0, 1)
    ]
    surface, variance, share, valid = (jnp.stack(part, axis=-1) for part in zip(*neighbours, strict=True))
    valid &= depth[:, None] > NEAREST_M
    behind = jnp.where(valid, depth[:, None] - surface, -jnp.inf)
    sigma = jnp.sqrt(variance + registration_sigma_m**2)
    measured = jnp.where(valid, share, 0.0).sum(axis=1)
    nearest = behind.argmax(axis=1, keepdims=True)
    apart = jnp.take_along_axis(behind, nearest, axis=1) - behind
    limit = SPLIT_SIGMAS * jnp.hypot(sigma, jnp.take_along_axis(sigma, nearest, axis=1))
    near = valid & (apart < jnp.maximum(limit, SPLIT_M))
    spare = 1 + UNMEASURED * (1 - measured) / jnp.maximum(measured, 1e-6)
    layers = [_mean_reading(behind, sigma, jnp.where(kept, share, 0.0)) for kept in (near, valid & ~near)]
    mean, deviation, weight = (jnp.stack(part, axis=-1) for part in zip(*layers, strict=True))
    association = jnp.where(weight > 0, weight * spare[:, None], 0.0)
    return Readings(mean, deviation, association, column, row, depth)


def _projected(
    camera: Camera, camera_from_grid: jax.Array, centres_m: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Image coordinates and depth (N,) of voxel centres; only the depth means something behind the camera."""
    point = centres_m @ camera_from_grid[:3, :3].T + camera_from_grid[None, :3, 3]
    z = jnp.where(point[:, 2] > NEAREST_M, point[:, 2], 1.0)
    return *project(camera, point[:, 0], point[:, 1], z), point[:, 2]


def _neighbour(
    planes: LocalPlanes, column: jax.Array, row: jax.Array, dv: int, du: int
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Depth of one neighbour's plane on the rays, its variance, bilinear weight and validity; each (N,)."""
    height, width = planes.valid.shape
    u, v = jnp.floor(column) + du, jnp.floor(row) + dv
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = jnp.clip(v, 0, height - 1).astype(jnp.int32), jnp.clip(u, 0, width - 1).astype(jnp.int32)
    right, down = column - u, row - v
    share = (1 - jnp.abs(right)) * (1 - jnp.abs(down))
    slope = planes.slope[(slice(None), *index)]
    inverse = planes.inverse_depth[index] + slope[0] * right + slope[1] * down
    depth = 1.0 / jnp.maximum(inverse, 1e-3)
    a, b, c, d, e, f = planes.covariance[(slice(None), *index)]
    variance = a + 2 * (b * right + c * down + e * right * down) + d * right**2 + f * down**2
    magnified = (depth * planes.inverse_depth[index]) ** 4
    return depth, variance * magnified, share, inside & planes.valid[index]


def _mean_reading(
    behind: jax.Array, sigma: jax.Array, share: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Mean, standard deviation and weight (N,) of neighbours (N, 4) that see one surface."""
    weight = share.sum(axis=1)
    part = share / jnp.maximum(weight, 1e-9)[:, None]
    value = jnp.where(share > 0, behind, 0.0)
    mean = (part * value).sum(axis=1)
    shared = OVERLAP + (1 - OVERLAP) * (part**2).sum(axis=1)
    spread = shared * (part * (sigma**2 + (value - mean[:, None]) ** 2)).sum(axis=1)
    return mean, jnp.sqrt(jnp.maximum(spread, 1e-12)), weight
