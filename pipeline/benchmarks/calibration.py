"""Simulation-based calibration: presences and poses on tables drawn from the model itself.

What was drawn is a draw of the posterior given its image: of presences p told, the share p is there, and the
true places are spread over the samples as one more sample (Talts et al. 2018). Presence and poses are those
of `parse_scene`, given the plane of the table and how well pixels foretell each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import stats

from pipeline.benchmarks.pose_methods import sought_shape
from pipeline.evaluation.calibration import PRESENCE_BINS, expected_calibration_error
from pipeline.evaluation.scenes import region_level
from pipeline.evaluation.trajectory_errors import LEVELS
from pipeline.mesh_source import MeshSource
from pipeline.seeds import stage_key
from pipeline.synthesis.model_tables import (
    NOISE,
    draw_table,
    intrinsics,
    learned_weights,
    told_support,
    unknown_table,
)
from scene.config import ParseConfig
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.parsing import parse_scene

ASKED = 3
"""Shapes asked of each table."""
CONFIG = ParseConfig(presence=0.5, unknown_solids=False)
LEAST_PROBABILITY = 1e-3
"""Of what is so, in the log loss: hundreds of rows tell no smaller ones."""


@dataclass(frozen=True, kw_only=True)
class CalibrationRow:
    """What a parse says of one of the shapes asked of a table.

    Attributes:
        table: its number.
        shape: asked for.
        sizes_drawn: whether objects have sizes of their own, as `ModelTable`.
        there: whether it was drawn.
        leans: whether it is there in none of its stable ways, as `ModelTable`.
        presence: told.
        error_m: distance of its middle, where it is there and found; else infinite.
        level: of the region told of its middle that the true one is on the edge of; None where not found.
        ranks: shares of samples whose middle lies before the true one along the camera's axes.
    """

    table: int
    shape: str
    sizes_drawn: bool
    there: bool
    leans: bool
    presence: float
    error_m: float
    level: float | None
    ranks: tuple[float, ...]


def judge_drawn(shapes: MeshSource, number: int, seed: int) -> list[CalibrationRow]:
    """The table of a number; every other one has sizes that were drawn. No rows where nothing can be parsed.

    What is left out thus is told by the image alone, so that the others are draws of their posteriors still.
    """
    rng = np.random.default_rng([seed, number, 24])
    names = rng.permutation(sorted(shapes.meshes))[:ASKED].tolist()
    objects = [sought_shape(shapes, name, 0, seed).scene_object for name in names]
    learned = _learned(shapes, seed)
    table = draw_table(rng, objects, CONFIG, learned, sizes_drawn=bool(number % 2))
    try:
        scene = parse_scene(
            stage_key(seed + number, "parse"),
            [table.frame],
            [0],
            np.eye(4)[None],
            intrinsics(),
            NOISE,
            objects,
            replace(CONFIG, support=told_support(table.camera_from_table)),
            unknown=unknown_table(learned),
        )
    except ValueError:
        return []
    rows = []
    for one, name in enumerate(names):
        row = CalibrationRow(
            table=number,
            shape=name,
            sizes_drawn=table.sizes_drawn,
            there=bool(table.there[one]),
            leans=bool(table.there[one] and not table.at_rest[one]),
            presence=float(scene.presence[one]),
            error_m=float("inf"),
            level=None,
            ranks=(),
        )
        if table.there[one] and scene.found[one]:
            true = table.camera_from_box[one] @ objects[one].box_from_object
            centre_m = objects[one].centre_m
            samples_m = scene.sampled_points(one, centre_m)
            true_m = true[:3, :3] @ centre_m + true[:3, 3]
            row = replace(
                row,
                error_m=float(np.linalg.norm(samples_m.mean(axis=0) - true_m)),
                level=region_level(scene, one, centre_m, true),
                ranks=tuple((samples_m < true_m).mean(axis=0).tolist()),
            )
        rows.append(row)
    return rows


@lru_cache(maxsize=1)
def _learned(shapes: MeshSource, seed: int) -> UnknownWeights:
    """Weights of all tables, from scenes of some of the shapes."""
    names = sorted(shapes.meshes)[:ASKED]
    objects = [sought_shape(shapes, name, 0, seed).scene_object for name in names]
    return learned_weights(np.random.default_rng([seed, 24]), objects, CONFIG)


def calibration_figures(rows: Sequence[CalibrationRow]) -> dict[str, Any]:
    """Of all rows, of those of things that the search looks for, and of those of either law of sizes."""
    laws = {
        "all": list(rows),
        "without what leans or floats": [one for one in rows if not one.leans],
        "sizes of the models": [one for one in rows if not one.sizes_drawn],
        "sizes drawn": [one for one in rows if one.sizes_drawn],
    }
    return {
        "laws": {law: _figures(mine) for law, mine in laws.items() if mine},
        "rows": [asdict(one) for one in rows],
    }


def _figures(rows: Sequence[CalibrationRow]) -> dict[str, Any]:
    told = np.array([one.presence for one in rows])
    there = np.array([one.there for one in rows])
    levels = np.array([one.level for one in rows if one.level is not None])
    ranks = np.array([one.ranks for one in rows if one.ranks]).ravel()
    likely = np.maximum(np.where(there, told, 1 - told), LEAST_PROBABILITY)
    return {
        "tables": len({one.table for one in rows}),
        "asked": len(rows),
        "there": int(there.sum()),
        "presence_sum": float(told.sum()),
        "ece": expected_calibration_error(told, there, PRESENCE_BINS),
        "log_loss": float(-np.log(likely).mean()),
        "poses": len(levels),
        "inside": {f"{level:.0%}": float((levels < level).mean()) for level in LEVELS} if len(levels) else {},
        "rank_p_value": float(stats.kstest(ranks, "uniform").pvalue) if len(ranks) else None,
        "outer_ranks": float(((ranks < 0.05) | (ranks > 0.95)).mean()) if len(ranks) else None,
    }


def calibration_lines(figures: dict[str, Any]) -> list[str]:
    """The same for people."""
    lines = []
    for law, group in figures["laws"].items():
        inside = ", ".join(f"{share:.0%} in the {level}" for level, share in group["inside"].items())
        lines.append(
            f"{law}: {group['tables']} tables, {group['there']} of {group['asked']} asked are there,"
            f" {group['presence_sum']:.1f} told; ECE {group['ece']:.3f}, log loss {group['log_loss']:.3f}"
        )
        if group["poses"]:
            lines.append(
                f"  {group['poses']} middles: {inside} regions; ranks beyond 5 and 95%:"
                f" {group['outer_ranks']:.0%}, Kolmogorov-Smirnov p {group['rank_p_value']:.2g}"
            )
    return lines
