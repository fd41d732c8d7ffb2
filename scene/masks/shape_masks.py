"""Masks of a shape: for every orientation the cells in which it has surface, near a few places on it.

Globally sparse, locally dense: HEADS places on the surface, and round each all surface cells within one
cell. Just outside each head are cells that are expected free, which count with the opposite sign.

A detector is the masks of a shape in both sizes of cells, kept in the user's cache folder: making them takes
about half a second a shape, reading them a hundredth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scene.objects import orientations
from scene.objects.orientations import tried_rotations
from scene.objects.scene_object import SceneObject
from shapes.array_cache import Arrays, cached_arrays
from shapes.rendering.object_library import WORDS, unpack

HEADS = 16
"""Of 8, 16 and 32 those with most objects found (development tables; docs/benchmarks.md)."""

MOST_CELLS = 128
"""Of a mask, kept at random: twice as many take twice the time, half as many find fewer (as HEADS)."""

SURFACE_POINTS = 4096
"""About three in a cell of 8 mm on an object of 1,000 cm^2."""

SURFACE, OUTSIDE = 2, -1
"""Weights of surface cells, and of those that are expected free, which neighbours may fill."""

OUTSIDE_CELLS, CLEAR_CELLS = 2.0, 1.5
"""Distances from the surface at which a head's outer cells lie, and which they keep."""

THINNEST_CELLS = 0.5
"""Of what is thinner in all its orientations no cell is filled: both of its sides lie in one."""

_CROSS = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


@dataclass(frozen=True, kw_only=True, eq=False)
class ShapeMasks:
    """Masks of one shape in k orientations for cells of one size.

    Attributes:
        rotations: (k, 3, 3) float32 grid_from_box.
        offsets: (k, MOST_CELLS, 3) int8, cells from that of the box's centre; places without use are zero.
        weights: (k, MOST_CELLS) int8, zero in places without use.
    """

    rotations: NDArray[np.float32]
    offsets: NDArray[np.int8]
    weights: NDArray[np.int8]

    @property
    def reach(self) -> int:
        """Most cells from the centre along an axis."""
        return int(np.abs(self.offsets).max(initial=0))

    @property
    def counts(self) -> NDArray[np.int32]:
        """(k,) places in use."""
        return (self.weights != 0).sum(axis=1).astype(np.int32)

    @property
    def most(self) -> NDArray[np.float32]:
        """(k,) the score of evidence 1 on all surface cells; 1 where there is none."""
        return np.maximum(np.maximum(self.weights, 0).sum(axis=1), 1).astype(np.float32)


def shape_masks(one: SceneObject, pitch_m: float, *, standing: bool) -> ShapeMasks:
    """The masks of an object.

    Args:
        one: the object.
        pitch_m: edge of a cell.
        standing: whether resting orientations come first, in a grid with z up.
    """
    rng = np.random.default_rng(0)
    rotations = tried_rotations(one.rests if standing else None)
    tree = KDTree(surface_m := _surface(one, rng))
    offsets = np.zeros((len(rotations), MOST_CELLS, 3), np.int8)
    weights = np.zeros((len(rotations), MOST_CELLS), np.int8)
    for number, rotation in enumerate(rotations):
        heads = rng.permutation(len(one.points_m))[:HEADS]
        centres = _cells(one.points_m[heads] @ rotation.T, pitch_m)
        near = _near_heads(_cells(surface_m @ rotation.T, pitch_m), centres)
        outer_m = one.points_m[heads] + OUTSIDE_CELLS * pitch_m * one.normals[heads]
        outer = _unique((_cells(outer_m @ rotation.T, pitch_m)[:, None] + _CROSS).reshape(-1, 3))
        outer = outer[tree.query(outer * pitch_m @ rotation)[0] > CLEAR_CELLS * pitch_m]
        cells = np.concatenate([near, outer])
        sign = np.repeat([SURFACE, OUTSIDE], [len(near), len(outer)])
        kept = rng.permutation(len(cells))[:MOST_CELLS]
        offsets[number, : len(kept)], weights[number, : len(kept)] = cells[kept], sign[kept]
    return ShapeMasks(rotations=rotations, offsets=offsets, weights=weights)


def _surface(one: SceneObject, rng: np.random.Generator) -> NDArray[np.float64]:
    """Points (P, 3) on the surface in the box frame: feet of the nearest voxels of its distance field."""
    library = one.library
    size = np.asarray(library.size[0])
    words = library.table[: WORDS * size.prod() : WORDS]
    distance, *normal = (np.asarray(part) for part in unpack(words))
    near = np.flatnonzero(np.abs(distance) < 0.5)
    near = rng.permutation(near)[:SURFACE_POINTS]
    centre = np.stack(np.unravel_index(near, size), axis=1) + 0.5
    foot = centre - distance[near, None] * np.stack(normal, axis=1)[near]
    pitch_m = float(library.pitch_m[0])
    return np.asarray(library.grid_origin_m[0], np.float64) + pitch_m * foot


def _cells(points_m: NDArray[np.floating], pitch_m: float) -> NDArray[np.int64]:
    """Cells (..., 3) of points, from that whose middle is the origin."""
    return np.rint(points_m / pitch_m).astype(np.int64)


def _near_heads(surface: NDArray[np.int64], heads: NDArray[np.int64]) -> NDArray[np.int64]:
    """The different ones of surface cells (P, 3) within one cell of a head (H, 3)."""
    surface = _unique(surface)
    apart = np.abs(surface[:, None] - heads[None]).max(axis=2)
    return surface[(apart <= 1).any(axis=1)]


def _unique(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """The different ones of cells (N, 3), whose components are less than 128."""
    codes = np.unique((cells + 128) @ np.array([1 << 16, 1 << 8, 1]))
    return np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=1) - 128


@dataclass(frozen=True, kw_only=True, eq=False)
class Detector:
    """Masks of one shape.

    Attributes:
        coarse: for cells twice as large as the fine ones.
        fine: the same orientations.
    """

    coarse: ShapeMasks
    fine: ShapeMasks


def is_thin(one: SceneObject, pitch_m: float) -> bool:
    """Whether an object is too thin for cells of this edge."""
    return bool(2 * one.half_extents_m.min() < THINNEST_CELLS * pitch_m)


def detector(one: SceneObject, pitch_m: float, *, standing: bool) -> Detector:
    """The detector of a shape, from the cache folder or made and kept there.

    Args:
        one: the object.
        pitch_m: edge of a fine cell.
        standing: whether resting orientations come first, in a grid with z up.
    """
    rotations = tried_rotations(one.rests if standing else None)
    cells = 2, len(rotations), MOST_CELLS
    shapes = {"offsets": (*cells, 3), "weights": cells}

    def make() -> Arrays:
        sizes = [shape_masks(one, pitch, standing=standing) for pitch in (2 * pitch_m, pitch_m)]
        return {part: np.stack([getattr(masks, part) for masks in sizes]) for part in shapes}

    def is_whole(arrays: Arrays) -> bool:
        return arrays.keys() == shapes.keys() and all(
            arrays[part].shape == shape and arrays[part].dtype == np.int8 for part, shape in shapes.items()
        )

    made_from = one.points_m, one.normals, one.rests, one.library.table, pitch_m, standing
    arrays = cached_arrays("masks", made_from, [__file__, orientations.__file__], make, is_whole)
    coarse, fine = (
        ShapeMasks(rotations=rotations, offsets=offsets, weights=weights)
        for offsets, weights in zip(arrays["offsets"], arrays["weights"], strict=True)
    )
    return Detector(coarse=coarse, fine=fine)
