"""Seconds of a parse against the number of objects on the table."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pipeline.benchmarks.pose_methods import Parse
from pipeline.benchmarks.pose_sources import Tables
from pipeline.benchmarks.poses import judgements
from pipeline.benchmarks.presence_figures import RIGHT_M
from pipeline.mesh_source import MeshSource

GROWTH_TABLES = 3
GROWTH_SEED = 800_000


def growth(shapes: MeshSource, method: Parse, most: int) -> Iterator[dict[str, Any]]:
    """Seconds for 1 to `most` objects, on the median of three tables, and what was compiled before."""
    for count in range(1, most + 1):
        seconds, compile_s, errors = [], 0.0, []
        tables = Tables(shapes=shapes, objects=count, seed=GROWTH_SEED, numbers=tuple(range(GROWTH_TABLES)))
        for key in tables.places():
            image = tables.image(key)
            compile_s += method.parsed(image, shapes, image.shapes)[1].compile_s
            estimated = method.estimate(image, shapes)
            seconds.append(estimated.seconds)
            errors += [one.error_m for one in judgements(image, method, estimated)]
        yield {
            "objects": count,
            "seconds": float(np.median(seconds)),
            "compile_s": compile_s,
            "under_1cm": float(np.mean(np.array(errors) < RIGHT_M)) if errors else None,
        }
