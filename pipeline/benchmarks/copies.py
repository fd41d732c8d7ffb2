"""Several things of one shape on a table: are they counted, and found?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pipeline.benchmarks.pose_images import ImageKey, PoseImage
from pipeline.benchmarks.pose_methods import Parse, sought_shape
from pipeline.benchmarks.pose_sources import filmed_image
from pipeline.benchmarks.presence_figures import RIGHT_M, VISIBLE
from pipeline.evaluation.intervals import wilson_interval
from pipeline.evaluation.scenes import object_errors
from pipeline.mesh_source import MeshSource
from pipeline.synthesis.filming import film_table
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import TableScene
from scene.config import ParseConfig
from scene.copies import shape_of, slot_names

COUNTS = (2, 3)
"""Things of one shape, in turn from table to table; one more is asked for."""
OTHERS = 2
"""Things of other shapes on a table, which are asked for too."""

LEAST_PROBABILITY = 1e-3
"""Of a number, in the log loss: tens of tables tell no smaller ones."""


@dataclass(frozen=True, kw_only=True)
class CopiesRow:
    """What a parse says of the things of one shape on a table.

    Attributes:
        table: its number.
        shape: of which there are several.
        there: how many.
        asked: for how many.
        found: how many are told to be there.
        expected: sum of their presences.
        numbers: probabilities that none, one, two and so on are there.
        right: how many are found within 1 cm.
    """

    table: int
    shape: str
    there: int
    asked: int
    found: int
    expected: float
    numbers: tuple[float, ...]
    right: int


def judge_copies(shapes: MeshSource, number: int, seed: int) -> CopiesRow | None:
    """The things of one shape on table `number`; None where one of them is hardly seen."""
    image, shape, count = table_of_copies(shapes, number, seed)
    named = [replace(one, shape=shape_of(one.shape, shapes.meshes)) for one in image.objects]
    copies = [one for one in named if one.shape == shape]
    if min(one.visible_fraction or 0 for one in copies) < VISIBLE:
        return None
    others = [one.shape for one in named if one.shape != shape]
    asked = dict.fromkeys(slot_names([shape], count + 1), shape) | {name: name for name in others}
    method = Parse(title="", config=ParseConfig(), seed=seed)
    sought = [
        replace(sought_shape(shapes, of, 0, seed).scene_object, name=name) for name, of in asked.items()
    ]
    scene, _ = method.parsed_objects(image, sought)
    slots = [place for place, of in enumerate(asked.values()) if of == shape]
    poses = [(shape, scene.camera_from_object[one]) for one in slots if scene.found[one]]
    errors = object_errors(copies, image.meshes, image.camera_from_world, poses)
    return CopiesRow(
        table=number,
        shape=shape,
        there=count,
        asked=count + 1,
        found=len(poses),
        expected=float(scene.presence[slots].sum()),
        numbers=tuple(scene.number_probabilities[slots[0], : len(slots) + 1].tolist()),
        right=sum(one.add_s_m < RIGHT_M for one in errors),
    )


def table_of_copies(shapes: MeshSource, number: int, seed: int) -> tuple[PoseImage, str, int]:
    """The image of a table, the shape of which there are several on it, and how many."""
    rng, count = np.random.default_rng([seed + number, 6]), COUNTS[number % len(COUNTS)]
    shape, *others = rng.permutation(sorted(shapes.meshes)).tolist()[: 1 + OTHERS]
    meshes = dict.fromkeys(slot_names([shape], count), shapes.meshes[shape])
    meshes |= {name: shapes.meshes[name] for name in others}
    scene = TableScene(objects=len(meshes), room=RoomConfig(kind="none"))
    film = film_table(meshes, scene, seed + number)
    return filmed_image(ImageKey("table", 0, number), film, shapes.meshes), shape, count


def copies_figures(rows: Sequence[CopiesRow]) -> dict[str, Any]:
    """Tables whose count is right with Wilson's 95% interval, things that are right, and mean counts."""
    if not rows:
        return {"tables": 0, "rows": []}
    right = sum(one.found == one.there for one in rows)
    return {
        "tables": len(rows),
        "counts_right": right,
        "interval": list(wilson_interval(right, len(rows))),
        "things": sum(one.there for one in rows),
        "things_right": sum(one.right for one in rows),
        "expected": float(np.mean([one.expected for one in rows])),
        "there": float(np.mean([one.there for one in rows])),
        "numbers": _number_figures(rows),
        "rows": [asdict(one) for one in rows],
    }


def _number_figures(rows: Sequence[CopiesRow]) -> dict[str, float]:
    """How often the likeliest number is right beside what was told of it, and the mean log loss."""
    told = [max(one.numbers) for one in rows]
    right = [int(np.argmax(one.numbers)) == one.there for one in rows]
    true = [max(one.numbers[one.there], LEAST_PROBABILITY) for one in rows]
    return {
        "likeliest_right": float(np.mean(right)),
        "likeliest_told": float(np.mean(told)),
        "log_loss": float(-np.log(true).mean()),
    }


def copies_lines(figures: dict[str, Any]) -> list[str]:
    """The same for people."""
    if not figures["tables"]:
        return ["no table shows all of its copies"]
    low, high = figures["interval"]
    number = figures["numbers"]
    return [
        f"{figures['counts_right']} of {figures['tables']} counts right ({low:.0%} to {high:.0%}),"
        f" {figures['things_right']} of {figures['things']} things within 1 cm",
        f"the likeliest number is right on {number['likeliest_right']:.0%},"
        f" told {number['likeliest_told']:.0%}; log loss of P(number) {number['log_loss']:.3f}",
        f"{figures['expected']:.2f} told on average where there are {figures['there']:.2f}",
    ]
