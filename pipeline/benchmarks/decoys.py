"""Things into which what is asked for may be laid by mistake: is it, and does the evidence say so?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.benchmarks.place_evidence import PlaceEvidence, laid_into
from pipeline.benchmarks.pose_images import ImageKey, PoseImage
from pipeline.benchmarks.pose_methods import Parse, sought_shape
from pipeline.benchmarks.pose_sources import filmed_image
from pipeline.benchmarks.presence_figures import RIGHT_M, VISIBLE
from pipeline.evaluation.intervals import wilson_interval
from pipeline.evaluation.object_poses import MISSING_M, add_s_m, model_points
from pipeline.mesh_source import MeshSource
from pipeline.synthesis.decoys import DECOY, KINDS, DecoyTable, film_decoy
from recordings.truth import TrueObject
from scene.config import ParseConfig
from scene.objects.scene_object import SceneObject

PRESENCE = 0.5
"""Prior that is told: of two kinds of tables half lack what is asked for."""


@dataclass(frozen=True, kw_only=True)
class DecoyRow:
    """What a parse says of the one thing that is asked for.

    Attributes:
        table: its number.
        kind: of `pipeline.synthesis.decoys.KINDS`.
        shape: that is asked for.
        there: whether it is.
        presence: that was told.
        error_m: ADD-S where it is there; 1 m where it was not found.
        advantage: log evidence of the truth less that of the likeliest place in the decoy, in nats.
    """

    table: int
    kind: str
    shape: str
    there: bool
    presence: float
    error_m: float
    advantage: float

    @property
    def right(self) -> bool:
        """Whether it is told where it is, or told absent where it is not there."""
        return self.error_m < RIGHT_M if self.there else self.presence < 0.5


def judge_decoy(shapes: MeshSource, number: int, seed: int) -> DecoyRow | None:
    """The table of a number; None where too little is seen of what is asked for, or of the decoy."""
    table = film_decoy(shapes.meshes, number, seed)
    image = filmed_image(ImageKey("decoy", 0, number), table.recording, shapes.meshes)
    if any((one.visible_fraction or 0) < VISIBLE for one in image.objects):
        return None
    sought = sought_shape(shapes, table.shape, 0, seed)
    config = ParseConfig(presence=PRESENCE)
    scene, _ = Parse(title="", config=config, seed=seed).parsed_objects(image, [sought.scene_object])
    found = scene.camera_from_object[0] @ sought.shape_from_object if scene.found[0] else None
    true = next((one for one in image.objects if one.shape == table.shape), None)
    error_m = MISSING_M
    if true is not None:
        points = model_points(shapes.meshes[table.shape])
        error_m = add_s_m(points, image.camera_from_world @ true.world_from_object, found)
    return DecoyRow(
        table=number,
        kind=table.kind,
        shape=table.shape,
        there=table.there,
        presence=float(scene.presence[0]),
        error_m=error_m,
        advantage=advantage(image, table, true, sought.scene_object, config, seed),
    )


def advantage(
    image: PoseImage,
    table: DecoyTable,
    true: TrueObject | None,
    sought: SceneObject,
    config: ParseConfig,
    seed: int,
) -> float:
    """Log evidence of the truth, its place or its absence, less that of the likeliest place in the decoy."""
    (decoy,) = (one for one in image.objects if one.shape == DECOY)
    weighed = PlaceEvidence.of(image.frame, image.intrinsics, sought, config, seed)
    laid = laid_into(
        image.camera_from_world @ decoy.world_from_object,
        table.decoy.extents / 2,
        sought.half_extents_m,
    )
    places = weighed.likeliest(laid)
    if true is not None:
        places = np.concatenate([true_box(image.camera_from_world, true, sought)[None], places])
    absent, there = weighed.log_evidence(places, seed)
    return float(there[0] - there[1:].max() if true is not None else absent - there.max())


def true_box(
    camera_from_world: NDArray[np.float64], true: TrueObject, sought: SceneObject
) -> NDArray[np.float64]:
    """camera_from_box (4, 4) of an object where it really is; its box may be turned against its mesh."""
    return camera_from_world @ true.world_from_object @ np.linalg.inv(sought.box_from_object)


def decoy_figures(rows: Sequence[DecoyRow]) -> dict[str, Any]:
    """By kind, tables that are right, and on which the truth has more evidence; Wilson's 95% intervals."""
    kinds = {kind: [one for one in rows if one.kind == kind] for kind in KINDS}
    groups = {"all": list(rows), **kinds}
    return {
        "decoys": {
            kind: {
                "tables": len(mine),
                "right": _share([one.right for one in mine]),
                "truth_ahead": _share([one.advantage > 0 for one in mine]),
                "least_advantage": min(one.advantage for one in mine),
            }
            for kind, mine in groups.items()
            if mine
        },
        "rows": [asdict(one) | {"right": one.right} for one in rows],
    }


def _share(right: Sequence[bool]) -> dict[str, Any]:
    return {"count": sum(right), "interval": list(wilson_interval(sum(right), len(right)))}


def decoy_lines(figures: dict[str, Any]) -> list[str]:
    """The same for people."""
    lines = ["kind     tables  right                truth ahead          least advantage"]
    for kind, group in figures["decoys"].items():
        cells = []
        for name in ("right", "truth_ahead"):
            low, high = group[name]["interval"]
            cells.append(f"{group[name]['count']:>5} ({low:>4.0%} to {high:>4.0%})")
        lines.append(
            f"{kind:<7}  {group['tables']:>6}  {'  '.join(cells)}  {group['least_advantage']:>10.1f} nats"
        )
    return lines
