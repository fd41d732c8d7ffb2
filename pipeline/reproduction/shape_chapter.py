"""Section C: shapes learned from five views, the supplement's Table 1."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.atomic import write_table
from pipeline.benchmarks.shapes import shape_rows
from pipeline.report.page import Page
from pipeline.reproduction.request import Request
from shapes.learning.config import LearnConfig

VIEWS, POSES, CONDITIONS = 5, "orbit", "paper"
FIGURES = ("solid", "ceiling", "reachable")


def shape_chapter(request: Request, page: Page) -> None:
    """C: every object under the paper's conditions, noise-free and noisy."""
    page.chapter("C. Shapes from five views")
    page.text(
        "A bare rectangular room, one circle at constant distance, the first pose of the object given, the "
        "camera found with that motion. Solid: IoU of the learned solid against the true one; ceiling: that "
        "of the true solid and all voxels that no noise-free ray of these views reaches; reachable: of what "
        "was learned against those. The supplement states neither its pitch nor its rule for hidden voxels."
    )
    page.listing("\n".join(_command(request, noise_free=noise_free) for noise_free in (True, False)))
    figures = [_rows(request, noise_free=noise_free) for noise_free in (True, False)]
    exact, noisy = ({row["object"]: row for row in rows} for rows in figures)
    header = ("object", *(f"{name}, {kind}" for kind in ("noise-free", "noisy") for name in FIGURES), "paper")
    rows = [
        (name, *_cells(exact[name]), *_cells(noisy[name]), _number(exact[name]["supplement"]))
        for name in exact
    ]
    means = [np.mean([row[name] for row in table]) for table in figures for name in FIGURES]
    told = [row["supplement"] for row in figures[0] if row["supplement"] is not None]
    rows.append(("mean", *map(_number, means), _number(np.mean(told) if told else None)))
    page.table(header, rows)
    named = (dict(zip(header, row, strict=True)) for row in rows)
    write_table(request.out / "tables" / "shapes.csv", header, named)


def _command(request: Request, *, noise_free: bool) -> str:
    """The command that measures the same rows as `_rows`."""
    about = ("--conditions", CONDITIONS, "--views", str(VIEWS), "--poses", POSES)
    exact = ("--noise-free",) if noise_free else ()
    return request.command("bench", "shapes", *about, *exact, "--against", "", "--no-growth")


def _rows(request: Request, *, noise_free: bool) -> list[Mapping[str, Any]]:
    found = shape_rows(
        replace(request.shapes, names=()).meshes,  # all, so that each is filmed alike whatever is asked for
        sorted(request.shapes.meshes),
        [VIEWS],
        [POSES],
        [],
        LearnConfig(),
        request.seed,
        request.rows / "shapes" / ("noise_free" if noise_free else "noisy"),
        CONDITIONS,
        noise_free=noise_free,
    )
    rows = []
    for row in found:
        rows.append(row.figures)
        request.say(f"{row.figures['object']}: reachable {row.figures['reachable']:.3f}")
    return rows


def _cells(row: Mapping[str, Any]) -> list[str]:
    return [_number(row[name]) for name in FIGURES]


def _number(value: Any) -> str:
    return "" if value is None else f"{value:.3f}"
