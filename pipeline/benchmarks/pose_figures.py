"""The figures of `bench poses`: errors by kind, shape and visible fraction, differences between columns."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise
from typing import Any

import numpy as np

from pipeline.benchmarks.paired_intervals import compared
from pipeline.benchmarks.pose_images import ImageKey
from pipeline.benchmarks.pose_rows import Judged
from pipeline.benchmarks.presence_figures import RIGHT_M, VISIBLE, Reported, presence_figures
from pipeline.evaluation.intervals import wilson_interval
from pipeline.evaluation.object_poses import error_figures
from pipeline.evaluation.trajectory_errors import LEVELS

BIN_EDGES = (0.0, 0.05, 0.15, 0.25, 0.5, 0.75, 1.0)
"""Between the bins of the visible fraction."""
TABLE_KIND = "table"


def pose_figures(judged: Sequence[Judged], seconds: Mapping[str, Mapping[ImageKey, float]]) -> dict[str, Any]:
    """Everything that is printed.

    Args:
        judged: rows of all methods.
        seconds: of each method on each image.
    """
    methods = list(dict.fromkeys(one.method for one in judged))
    presence = {method: _presence([one for one in judged if one.method == method]) for method in methods}
    judged = [one for one in judged if one.there]
    by_method = {method: [one for one in judged if one.method == method] for method in methods}
    return {
        "images": len({one.image for one in judged}),
        "methods": {method: _figures(rows, seconds.get(method, {})) for method, rows in by_method.items()},
        "by_shape": _by_shape(judged, methods),
        "by_visible_fraction": _by_visible_fraction(judged, methods),
        "differences": differences(judged, methods),
        "presence": {method: figures for method, figures in presence.items() if figures is not None},
    }


def _presence(rows: Sequence[Judged]) -> dict[str, Any] | None:
    """Whether what was told with a probability was so, where some that was asked for was not there."""
    if all(one.there for one in rows):
        return None
    return presence_figures(
        [
            Reported(
                shape=one.shape,
                presence=one.score,
                there=one.there,
                error_m=one.error_m if one.there else np.inf,
            )
            for one in rows
            if one.score is not None and (not one.there or (one.visible_fraction or 0) >= VISIBLE)
        ]
    )


def groups(judged: Sequence[Judged]) -> dict[str, list[Judged]]:
    """All rows, those of each kind, and on tables those that stand on it and those that are stacked."""
    kinds = list(dict.fromkeys(one.kind for one in judged))
    found = {"all": list(judged)}
    if len(kinds) > 1:
        found |= {kind: [one for one in judged if one.kind == kind] for kind in kinds}
    tables = [one for one in judged if one.kind == TABLE_KIND]
    found["on the table"] = [one for one in tables if not one.stacked]
    found["stacked on tables"] = [one for one in tables if one.stacked]
    return {name: rows for name, rows in found.items() if rows}


def differences(judged: Sequence[Judged], methods: Sequence[str]) -> list[dict[str, Any]]:
    """The first method's share of right objects less each other's, by kind and by visible fraction."""
    if len(methods) < 2:
        return []
    found = []
    for group, rows in groups(judged).items():
        for bin_, members in {"": rows, **_bins(rows)}.items():
            right = {
                method: {_object(one): one.error_m < RIGHT_M for one in members if one.method == method}
                for method in methods
            }
            images = {_object(one): one.image for one in members}
            for other in methods[1:]:
                difference = compared(right, methods[0], other, images)
                if difference is not None:
                    about = {"group": group, "visible": bin_, "first": methods[0], "second": other}
                    found.append(about | asdict(difference))
    return found


def _figures(rows: Sequence[Judged], seconds: Mapping[ImageKey, float]) -> dict[str, Any]:
    times = list(seconds.values())
    return {
        "setting": rows[0].setting,
        "rows": {group: _errors(ones) for group, ones in groups(rows).items()},
        "edges": {
            "flush": _edges(one for one in rows if one.flush),
            "other": _edges(one for one in rows if not one.flush),
        },
        "coverage": _coverage([one.level for one in rows if one.level is not None]),
        "seconds_median": float(np.median(times)) if times else None,
        "seconds_most": float(np.max(times)) if times else None,
    }


def _coverage(levels: Sequence[float]) -> dict[str, Any] | None:
    """Shares of true middles inside the regions that are told; None where no regions are."""
    if not levels:
        return None
    inside = {f"{level:.0%}": float((np.asarray(levels) < level).mean()) for level in LEVELS}
    return {"objects": len(levels), "inside": inside}


def _by_shape(judged: Sequence[Judged], methods: Sequence[str]) -> list[dict[str, Any]]:
    places = dict.fromkeys((one.kind, one.shape) for one in judged)
    return [
        {"kind": kind, "shape": shape, "method": method, **_errors(rows)}
        for kind, shape in sorted(places)
        for method in methods
        if (rows := [one for one in judged if (one.kind, one.shape, one.method) == (kind, shape, method)])
    ]


def _by_visible_fraction(judged: Sequence[Judged], methods: Sequence[str]) -> list[dict[str, Any]]:
    return [
        {"visible": bin_, "method": method, **_errors(rows)}
        for bin_, members in _bins(judged).items()
        for method in methods
        if (rows := [one for one in members if one.method == method])
    ]


def _bins(judged: Iterable[Judged]) -> dict[str, list[Judged]]:
    """Rows by how much of the object is seen, where somebody counted."""
    bins: dict[str, list[Judged]] = {f"{low:.0%} to {high:.0%}": [] for low, high in pairwise(BIN_EDGES)}
    names = list(bins)
    for one in judged:
        if one.visible_fraction is not None:
            place = int(np.digitize(one.visible_fraction, BIN_EDGES[1:-1]))
            bins[names[place]].append(one)
    return {name: rows for name, rows in bins.items() if rows}


def _errors(rows: Sequence[Judged]) -> dict[str, Any]:
    """Errors, and Wilson's 95% interval of the share that is right, as if objects erred independently."""
    right = sum(one.error_m < RIGHT_M for one in rows)
    return {
        "objects": len(rows),
        **error_figures([one.error_m for one in rows]),
        "right_interval": list(wilson_interval(right, len(rows))),
    }


def _edges(judged: Iterable[Judged]) -> dict[str, Any]:
    told = [one.parent_right for one in judged if one.parent_right is not None]
    return {"rests": len(told), "right": float(np.mean(told)) if told else None}


def _object(one: Judged) -> tuple[ImageKey, str]:
    return one.image, one.name
