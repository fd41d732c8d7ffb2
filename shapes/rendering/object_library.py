"""Rigid objects as the kernels see them: for every voxel the tangent planes of its two nearest sheets.

The first plane is that of the nearest surface; the second faces elsewhere, like the back of a wall or the
next side of a box: the solid is behind both. One 32-bit word holds a plane: the signed distance of the
voxel's centre and the unit normal there, so that a single lookup gives the distance of any point in the
voxel to first order. All objects of a library share one table and an object is a traced index, so other
objects compile nothing anew.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from shapes.rendering.mesh_distance import Sheets, nearest_sheets

MARGIN = 3
"""Free voxels around an object: what leaves the grid is at least this far from the surface."""

DISTANCE_STEPS = 16
"""Distances are stored in sixteenths of a voxel, up to 64 voxels."""

SECOND_STEPS = 128
"""Distances from second planes, which are near, are stored in such parts of a voxel, up to 8 voxels."""

NORMAL_STEPS = 63

WORDS = 2
"""Of a voxel, one a plane."""

LEVELS = 3
"""Levels of detail: the voxels of each are twice as large as those before."""

DEFAULT_VOXELS = 2**19
"""Voxels of an object unless its pitch is given: 4 MiB, about 1.3 mm for an object of 10 cm."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ObjectLibrary:
    """M rigid objects.

    Attributes:
        table: (T,) int32, the packed voxels of all objects, level after level.
        first_voxel: (M,) int32, where each object's voxels start, counted in voxels.
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
    levels = []
    for level in range(LEVELS):
        edge = pitch_m * 2**level
        sheets = nearest_sheets((vertices_m - origin) / edge, faces, tuple((size // 2**level).tolist()))
        levels.append(_packed(sheets).ravel())
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
        replace(
            library, table=np.zeros(0, np.int32), first_voxel=library.first_voxel + np.int32(start // WORDS)
        )
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


def _packed(sheets: Sheets) -> NDArray[np.int32]:
    """Two words a voxel, one a plane: 11 bits of distance and 3 x 7 of normal."""
    steps = np.clip(np.rint(sheets.distance * DISTANCE_STEPS), -1024, 1023).astype(np.int32)
    has_second = sheets.second_normal.any(axis=-1)
    second = np.clip(np.rint(sheets.second_distance * SECOND_STEPS), -1024, 1023).astype(np.int32)
    second = np.where(has_second, second, -1024)
    words = [steps << 21 | _packed_normal(sheets.normal), second << 21 | _packed_normal(sheets.second_normal)]
    return np.stack(words, axis=-1)


def _packed_normal(normal: NDArray[np.float32]) -> NDArray[np.int32]:
    x, y, z = np.moveaxis(np.rint(normal * NORMAL_STEPS).astype(np.int32) & 127, -1, 0)
    return x << 14 | y << 7 | z


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


def signed_distances_m(library: ObjectLibrary) -> NDArray[np.float32]:
    """Distances (I, J, K) of the middles of one object's finest voxels from its surface, negative inside."""
    size = np.asarray(library.size[0])
    words = np.asarray(library.table)[: WORDS * size.prod() : WORDS]
    steps = (words >> 21).astype(np.float32).reshape(size)
    return steps * np.float32(library.pitch_m[0] / DISTANCE_STEPS)


def unpack(word: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Signed distance of voxel centres from the nearest sheet, in voxels, and the normal's components."""
    return ((word >> 21).astype(jnp.float32) * (1.0 / DISTANCE_STEPS), *_unpacked_normal(word))


def unpack_second(word: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The same of the second plane; a distance far behind it and no normal where there is none."""
    return ((word >> 21).astype(jnp.float32) * (1.0 / SECOND_STEPS), *_unpacked_normal(word))


def _unpacked_normal(word: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    return (
        (word << 11 >> 25).astype(jnp.float32) * (1.0 / NORMAL_STEPS),
        (word << 18 >> 25).astype(jnp.float32) * (1.0 / NORMAL_STEPS),
        (word << 25 >> 25).astype(jnp.float32) * (1.0 / NORMAL_STEPS),
    )
