"""Compiled detectors: the masks of a shape in both sizes of cells, kept in the user's cache folder.

Making them takes about half a second a shape, reading them a hundredth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scene.masks import shape_masks as masks_source
from scene.masks.shape_masks import MOST_CELLS, ShapeMasks, shape_masks
from scene.objects import orientations as rotations_source
from scene.objects.orientations import tried_rotations
from scene.objects.scene_object import SceneObject
from shapes.array_cache import Arrays, cached_arrays

THINNEST_CELLS = 0.5
"""Of what is thinner in all its orientations no cell is filled: both of its sides lie in one."""


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
    shapes = {"offsets": (len(rotations), MOST_CELLS, 3), "weights": (len(rotations), MOST_CELLS)}

    def make() -> Arrays:
        pitches_m = {"coarse": 2 * pitch_m, "fine": pitch_m}
        made = {name: shape_masks(one, pitch, standing=standing) for name, pitch in pitches_m.items()}
        return {f"{name}_{part}": getattr(masks, part) for name, masks in made.items() for part in shapes}

    def is_whole(arrays: Arrays) -> bool:
        wanted = {f"{name}_{part}": shape for name in ("coarse", "fine") for part, shape in shapes.items()}
        return arrays.keys() == wanted.keys() and all(
            arrays[name].shape == shape and arrays[name].dtype == np.int8 for name, shape in wanted.items()
        )

    made_from = one.points_m, one.normals, one.rests, one.library.table, pitch_m, standing
    sources = [masks_source.__file__, rotations_source.__file__]
    arrays = cached_arrays("masks", made_from, sources, make, is_whole)
    masks = {
        name: ShapeMasks(rotations=rotations, **{part: arrays[f"{name}_{part}"] for part in shapes})
        for name in ("coarse", "fine")
    }
    return Detector(**masks)
