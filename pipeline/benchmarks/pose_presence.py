"""Tables of `bench poses --absent`: shapes are asked for in the place of others that are there."""

from __future__ import annotations

import numpy as np

from pipeline.benchmarks.pose_methods import Parse
from pipeline.benchmarks.pose_sources import Tables
from pipeline.benchmarks.presence_figures import VISIBLE, Reported
from pipeline.evaluation.scenes import object_errors
from scene.config import ParseConfig


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
