"""What `bench poses --absent` found: are shapes that are not there told from those that are?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.benchmarks.pose_methods import Parse
from pipeline.benchmarks.pose_sources import Tables
from pipeline.evaluation.scenes import object_errors
from scene.config import ParseConfig

BOUNDS = (0.05, 0.5, 0.9, 0.98)
"""Between the bins of presence."""
RIGHT_M = 0.01
VISIBLE = 0.25
"""Whether an object is there is not asked where less of it is seen."""


@dataclass(frozen=True, kw_only=True)
class Reported:
    """What was said of one shape that was asked for.

    Attributes:
        shape: its name.
        presence: the probability that was told.
        there: whether it is on the table and enough of it is seen.
        error_m: ADD-S where it is there, found or not, else infinite.
    """

    shape: str
    presence: float
    there: bool
    error_m: float

    @property
    def found(self) -> bool:
        """Whether it was said to be there."""
        return self.presence >= 0.5

    @property
    def right(self) -> bool:
        """Whether it is there, and, if it was found, where it was said to be."""
        return self.there and (not self.found or self.error_m < RIGHT_M)


def presences(tables: Tables, number: int, absent: int, seed: int) -> list[Reported]:
    """What is said on table `number` if of its objects so many others are asked for in the place of some.

    The prior told is the share of those asked for that are there; those of which too little is seen do not
    count.
    """
    (key,) = (one for one in tables.places() if one.im_id == number)
    image = tables.image(key)
    names, rng = image.shapes, np.random.default_rng([tables.seed + number, absent])
    others = [name for name in sorted(tables.shapes.meshes) if name not in names]
    swapped = min(absent, len(names), len(others))
    asked = sorted({*rng.permutation(names)[swapped:], *rng.permutation(others)[:swapped]})
    share = np.clip(1 - swapped / len(asked), 0.1, 0.9)
    method = Parse(title="", config=ParseConfig(presence=float(share)), seed=seed)
    scene, _ = method.parsed(image, tables.shapes, asked)
    found = object_errors(
        image.objects, image.meshes, image.camera_from_world, method.poses(scene, tables.shapes)
    )
    errors = {one.name: one.add_s_m for one in found}
    judged = {one.shape: errors[one.name] for one in image.objects if (one.visible_fraction or 0) >= VISIBLE}
    return [
        Reported(shape=name, presence=float(presence), there=name in judged, error_m=judged.get(name, np.inf))
        for name, presence in zip(scene.names.tolist(), scene.presence, strict=True)
        if name in judged or name not in names
    ]


def presence_figures(reported: Sequence[Reported]) -> dict[str, Any]:
    """Counts, and for every bin of presence that holds some how many were right."""
    places = np.digitize([one.presence for one in reported], BOUNDS)
    rows = [
        [reported[one] for one in np.flatnonzero(places == place).tolist()] for place in np.unique(places)
    ]
    return {
        "asked": len(reported),
        "absent": sum(not one.there for one in reported),
        "false": sum(one.found and not one.right for one in reported),
        "missed": sum(one.there and not one.found for one in reported),
        "calibration": [
            {
                "count": len(row),
                "presence": float(np.mean([one.presence for one in row])),
                "right": float(np.mean([one.right for one in row])),
            }
            for row in rows
        ],
    }
