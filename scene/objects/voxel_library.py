"""Voxels of objects for the renderer, kept in the user's cache folder.

Making them takes about a second an object, and of a learned shape that for each of its draws; reading them
takes a thirtieth.
"""

from __future__ import annotations

from dataclasses import fields

import jax
import numpy as np
from numpy.typing import NDArray

from shapes.array_cache import Arrays, cached_arrays
from shapes.rendering import mesh_distance, object_library
from shapes.rendering.object_library import LEVELS, WORDS, ObjectLibrary, library_of_mesh

_COLUMNS = {
    "first_voxel": ((1,), np.int32),
    "size": ((1, 3), np.int32),
    "pitch_m": ((1,), np.float32),
    "grid_origin_m": ((1, 3), np.float32),
    "centre_m": ((1, 3), np.float32),
    "half_extent_m": ((1, 3), np.float32),
    "radius_m": ((1,), np.float32),
}
"""Of one object, beside the table."""


def voxelise(vertices_m: NDArray[np.floating], faces: NDArray[np.integer], pitch_m: float) -> ObjectLibrary:
    """`library_of_mesh`, from the cache folder or made and kept there.

    Raises:
        ValueError: as that.
    """

    def make() -> Arrays:
        library = library_of_mesh(vertices_m, faces, pitch_m)
        return {field.name: np.asarray(getattr(library, field.name)) for field in fields(library)}

    sources = [mesh_distance.__file__, object_library.__file__]
    arrays = cached_arrays("voxels", (vertices_m, faces, pitch_m), sources, make, _is_whole)
    return ObjectLibrary(**{name: jax.device_put(array) for name, array in arrays.items()})


def _is_whole(arrays: Arrays) -> bool:
    """Whether they are the library of one object: kernels look its voxels up without a check."""
    if arrays.keys() != {*_COLUMNS, "table"}:
        return False
    for name, (shape, kind) in _COLUMNS.items():
        if arrays[name].shape != shape or arrays[name].dtype != kind:
            return False
    table, size = arrays["table"], arrays["size"][0].astype(np.int64)
    voxels = sum(int(np.prod(size // 2**level)) for level in range(LEVELS))
    fits = table.dtype == np.int32 and table.shape == (WORDS * voxels,) and (size > 0).all()
    return bool(fits and arrays["first_voxel"][0] == 0)
