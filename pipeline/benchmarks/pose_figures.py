"""What `bench poses` found, object by object, and the figures of its rows."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import PipelineError
from pipeline.evaluation.object_poses import error_figures


@dataclass(frozen=True, kw_only=True)
class Judged:
    """One method's error on one object.

    Attributes:
        method: its name.
        setting: the one that was chosen for it; empty where there is no choice.
        table: number of the table.
        shape: of the object.
        error_m: ADD-S.
        visible_fraction: of the object.
        stacked: the object rests on another.
        flush: it rests on a face of its bounding box.
        parent_right: where the method tells parents.
        seconds: that the method took for the whole table, without compiling.
    """

    method: str
    setting: str
    table: int
    shape: str
    error_m: float
    visible_fraction: float
    stacked: bool
    flush: bool
    parent_right: bool | None
    seconds: float


def pose_figures(judged: Sequence[Judged]) -> dict[str, Any]:
    """The figures of each method: rows of errors, edges, seconds."""
    methods = dict.fromkeys(one.method for one in judged)
    return {
        "tables": len({one.table for one in judged}),
        "methods": {method: _figures([one for one in judged if one.method == method]) for method in methods},
    }


def _figures(judged: Sequence[Judged]) -> dict[str, Any]:
    rows = {
        "all": judged,
        "on the table": [one for one in judged if not one.stacked],
        "stacked": [one for one in judged if one.stacked],
    }
    seconds = list({one.table: one.seconds for one in judged}.values())
    return {
        "setting": judged[0].setting,
        "rows": {
            row: {"objects": len(ones), **error_figures([one.error_m for one in ones])}
            for row, ones in rows.items()
            if ones
        },
        "edges": {
            "flush": _edges(one for one in judged if one.flush),
            "other": _edges(one for one in judged if not one.flush),
        },
        "seconds_median": float(np.median(seconds)),
        "seconds_most": float(np.max(seconds)),
    }


def _edges(judged: Iterable[Judged]) -> dict[str, Any]:
    told = [one.parent_right for one in judged if one.parent_right is not None]
    return {"rests": len(told), "right": float(np.mean(told)) if told else None}


def append_rows(path: Path, judged: Sequence[Judged]) -> None:
    """Add rows to a CSV file, which is begun if there is none."""
    begun = path.exists() and path.stat().st_size > 0
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Judged)])
        if not begun:
            writer.writeheader()
        writer.writerows(asdict(one) for one in judged)


def read_rows(path: Path) -> list[Judged]:
    """What `append_rows` wrote; nothing where there is no file.

    Raises:
        PipelineError: the file holds something else.
    """
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        try:
            return [_judged(row) for row in csv.DictReader(file)]
        except (KeyError, ValueError, TypeError) as error:
            raise PipelineError(f"{path} was not written by bench poses: {error}") from error


def _judged(row: dict[str, str]) -> Judged:
    truth = {"True": True, "False": False, "": None}
    flags = {name: truth[row[name]] for name in ("stacked", "flush", "parent_right")}
    numbers = {name: float(row[name]) for name in ("error_m", "visible_fraction", "seconds")}
    return Judged(**(row | flags | numbers | {"table": int(row["table"])}))  # pyright: ignore[reportArgumentType]
