"""Compiled detectors: the masks of a shape in both sizes of cells, kept in the user's cache folder.

Making them takes about half a second a shape, reading them a hundredth.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

from scene.masks import shape_masks as masks_source
from scene.masks.shape_masks import MOST_CELLS, ShapeMasks, shape_masks
from scene.objects import orientations as rotations_source
from scene.objects.orientations import tried_rotations
from scene.objects.scene_object import SceneObject
from shapes.archive import load_arrays, save_arrays

THINNEST_CELLS = 0.5
"""Of what is thinner in all its orientations no cell is filled: both of its sides lie in one."""

_log = logging.getLogger("voxscene.masks")


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


def detector(one: SceneObject, pitch_m: float, *, standing: bool, seed: int = 0) -> Detector:
    """The detector of a shape, from the cache folder or made and kept there.

    A damaged file is made anew; where the folder cannot be written the detector is made each time.

    Args:
        one: the object.
        pitch_m: edge of a fine cell.
        standing: whether resting orientations come first, in a grid with z up.
        seed: of the masks.
    """
    path = _path(one, pitch_m, standing, seed)
    kept = _read(path, one, standing)
    if kept is not None:
        return kept
    made = Detector(
        coarse=shape_masks(one, 2 * pitch_m, standing=standing, seed=seed),
        fine=shape_masks(one, pitch_m, standing=standing, seed=seed),
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_arrays(path, _arrays(made))
    except OSError as error:
        _log.info("masks of %s are not kept, %s cannot be written: %s", one.name, path, error)
    return made


def _path(one: SceneObject, pitch_m: float, standing: bool, seed: int) -> Path:
    """Where masks are kept that were made of this shape, by this program, with these numbers."""
    digest = hashlib.sha256(repr((pitch_m, standing, seed)).encode())
    for source in (masks_source.__file__, rotations_source.__file__):
        digest.update(Path(source).read_bytes())
    for array in (one.points_m, one.normals, one.rests, one.library.table):
        digest.update(np.ascontiguousarray(array).tobytes())
    return user_cache_path("voxscene", appauthor=False) / "masks" / f"{digest.hexdigest()[:32]}.npz"


def _arrays(made: Detector) -> dict[str, NDArray]:
    return {
        f"{name}_{part}": getattr(masks, part)
        for name, masks in (("coarse", made.coarse), ("fine", made.fine))
        for part in ("offsets", "weights")
    }


def _read(path: Path, one: SceneObject, standing: bool) -> Detector | None:
    """What a file holds; None where there is none, or a damaged one."""
    rotations = tried_rotations(one.rests if standing else None)
    shapes = {"offsets": (len(rotations), MOST_CELLS, 3), "weights": (len(rotations), MOST_CELLS)}
    try:
        arrays = load_arrays(path)
        parts = {name: {part: arrays[f"{name}_{part}"] for part in shapes} for name in ("coarse", "fine")}
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, OSError) as error:
        _log.info("masks of %s are made anew: %s", one.name, error)
        return None
    whole = all(
        array.shape == shapes[part] and array.dtype == np.int8
        for each in parts.values()
        for part, array in each.items()
    )
    if not whole:
        _log.info("masks of %s are made anew: %s does not hold them", one.name, path)
        return None
    return Detector(**{name: ShapeMasks(rotations=rotations, **each) for name, each in parts.items()})
