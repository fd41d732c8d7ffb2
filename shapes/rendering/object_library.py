"""Rigid objects as the kernels see them: for every voxel the tangent plane of the nearest surface.

One 32-bit word holds a voxel: the signed distance of its centre and the unit normal there, so that a
single lookup gives the distance of any point in the voxel to first order. All objects of a library share
one table and an object is a traced index, so other objects compile nothing anew.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from shapes.rendering.mesh_distance import signed_distance

MARGIN = 3
"""Free voxels around an object: what leaves the grid is at least this far from the surface."""

DISTANCE_STEPS = 16
"""Distances are stored in sixteenths of a voxel, up to 64 voxels."""

NORMAL_STEPS = 63

LEVELS = 3
"""Levels of detail: the voxels of each are twice as large as those before."""

DEFAULT_VOXELS = 2**20
"""Voxels of an object unless its pitch is given: 4 MiB, about 1 mm for an object of 10 cm."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ObjectLibrary:
    """M rigid objects.

    Attributes:
        table: (T,) int32, the packed voxels of all objects, level after level.
        first_voxel: (M,) int32, where each object's voxels start.
        size: (M, 3) int32, voxels per axis; voxel (i, j, k) is at (i size_y + j) size_z + k. A level has
            half the voxels per axis of the one before it.
        pitch_m: (M,) edge of the finest voxels.
        grid_origin_m: (M, 3) corner of voxel (0, 0, 0) in the object's frame.
        centre_m: (M, 3) centre of the bounding box in the object's frame.
        half_extent_m: (M, 3) half the edges of the bounding box.
        radius_m: (M,) of the bounding sphere round the centre.
    """

    table: jax.Array
    first_voxel: jax.Array
    size: jax.Array
    pitch_m: jax.Array
    grid_origin_m: jax.Array
    centre_m: jax.Array
    half_extent_m: jax.Array
    radius_m: jax.Array

    def __len__(self) -> int:
        return len(self.pitch_m)


def library_of_mesh(
    vertices_m: NDArray[np.floating], faces: NDArray[np.integer], pitch_m: float | None = None
) -> ObjectLibrary:
    """A library of one object, whose frame is that of the mesh.

    Args:
        vertices_m: (V, 3).
        faces: (F, 3) vertex indices; holes, flipped faces and inner walls are allowed.
        pitch_m: edge of a voxel; None fits the grid to `DEFAULT_VOXELS`.

    Raises:
        ValueError: there is no face, a vertex is not finite or the mesh has no extent.
    """
    vertices_m, faces = np.asarray(vertices_m, np.float64), np.asarray(faces)
    if not len(faces):
        raise ValueError("a mesh without faces has no surface")
    used = vertices_m[np.unique(faces)]
    if not np.isfinite(used).all():
        raise ValueError("a vertex of the mesh is not finite")
    low, high = used.min(axis=0), used.max(axis=0)
    centre, extent = (low + high) / 2, high - low
    if extent.max() <= 0:
        raise ValueError("the mesh has no extent")
    pitch_m = _fitting_pitch(extent) if pitch_m is None else pitch_m
    size = _grid_size(extent, pitch_m)
    origin = centre - size * pitch_m / 2
    distance, gradient = signed_distance((vertices_m - origin) / pitch_m, faces, tuple(size.tolist()))
    levels = [_packed(*level).ravel() for level in _levels(distance, gradient)]
    put = jax.device_put  # compiles nothing
    return ObjectLibrary(
        table=put(np.concatenate(levels)),
        first_voxel=put(np.zeros(1, np.int32)),
        size=put(size[None].astype(np.int32)),
        pitch_m=put(np.array([pitch_m], np.float32)),
        grid_origin_m=put(origin[None].astype(np.float32)),
        centre_m=put(centre[None].astype(np.float32)),
        half_extent_m=put((extent[None] / 2).astype(np.float32)),
        radius_m=put(np.array([np.linalg.norm(used - centre, axis=1).max()], np.float32)),
    )


def join(libraries: Sequence[ObjectLibrary]) -> ObjectLibrary:
    """One library of all objects, in order; its table is padded to a power of two against recompilation."""
    libraries = [jax.tree.map(np.asarray, library) for library in libraries]
    tables = [library.table for library in libraries]
    starts = np.cumsum([0] + [len(table) for table in tables])
    table = np.zeros(1 << int(starts[-1] - 1).bit_length(), np.int32)
    table[: starts[-1]] = np.concatenate(tables)
    moved = [
        replace(library, table=np.zeros(0, np.int32), first_voxel=library.first_voxel + np.int32(start))
        for library, start in zip(libraries, starts[:-1], strict=True)
    ]
    columns = jax.tree.map(lambda *leaves: np.concatenate(leaves), *moved)
    return jax.device_put(replace(columns, table=table))


def _fitting_pitch(extent_m: NDArray[np.float64]) -> float:
    """The pitch at which the grid, margins included, has about `DEFAULT_VOXELS` voxels."""
    low, high = extent_m.max() / DEFAULT_VOXELS, extent_m.max()
    for _ in range(60):
        pitch = np.sqrt(low * high)
        too_many = np.prod(_grid_size(extent_m, pitch)) > DEFAULT_VOXELS
        low, high = (pitch, high) if too_many else (low, pitch)
    return float(high)


def _grid_size(extent_m: NDArray[np.float64], pitch_m: float) -> NDArray[np.int64]:
    """Voxels per axis, margins included, that the coarsest level divides."""
    coarsest = 2 ** (LEVELS - 1)
    return np.ceil((np.ceil(extent_m / pitch_m) + 2 * MARGIN) / coarsest).astype(int) * coarsest


def _levels(
    distance: NDArray[np.float32], gradient: NDArray[np.float32]
) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Distance in voxels of its own and unit gradient of each level: means over the level before."""
    for level in range(LEVELS):
        if level:
            distance = _mean_of_eight(distance[..., None])[..., 0] * np.float32(0.5)
            gradient = _mean_of_eight(gradient)
            gradient /= np.maximum(np.linalg.norm(gradient, axis=-1, keepdims=True), 1e-9)
        yield distance, gradient


def _mean_of_eight(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means (X/2, Y/2, Z/2, C) over the eight voxels under each larger one, of values (X, Y, Z, C)."""
    x, y, z, channels = values.shape
    return values.reshape(x // 2, 2, y // 2, 2, z // 2, 2, channels).mean(axis=(1, 3, 5))


def _packed(distance: NDArray[np.float32], gradient: NDArray[np.float32]) -> NDArray[np.int32]:
    """Words of 11 bits of distance and 3 x 7 bits of normal."""
    steps = np.clip(np.rint(distance * DISTANCE_STEPS), -1024, 1023).astype(np.int32)
    x, y, z = np.moveaxis(np.rint(gradient * NORMAL_STEPS).astype(np.int32) & 127, -1, 0)
    return steps << 21 | x << 14 | y << 7 | z


def level_of(
    library: ObjectLibrary, model: jax.Array, level: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Pitch (B,), voxels per axis (3, B) and first voxel (B,) of objects `model` at levels of detail (B,)."""
    pitch, size, first_voxel = library.pitch_m[model], library.size.T[:, model], library.first_voxel[model]
    for coarser in range(1, LEVELS):
        reached = level >= coarser
        first_voxel = jnp.where(reached, first_voxel + size[0] * size[1] * size[2], first_voxel)
        size = jnp.where(reached[None], size // 2, size)
        pitch = jnp.where(reached, 2 * pitch, pitch)
    return pitch, size, first_voxel


def unpack(word: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Signed distance of voxel centres in voxels, and the components of the unit normals."""
    return (
        (word >> 21).astype(jnp.float32) * (1.0 / DISTANCE_STEPS),
        (word << 11 >> 25).astype(jnp.float32) * (1.0 / NORMAL_STEPS),
        (word << 18 >> 25).astype(jnp.float32) * (1.0 / NORMAL_STEPS),
        (word << 25 >> 25).astype(jnp.float32) * (1.0 / NORMAL_STEPS),
    )
