"""The tables of `bench poses` as lines for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pipeline.benchmarks.pose_rows import Judged
from pipeline.benchmarks.presence_figures import RIGHT_M


def image_line(found: Sequence[tuple[str, Sequence[Judged], float]]) -> str:
    """Of each method how many of an image's objects are right, in how many seconds."""
    cells, name = [], ""
    for method, rows, seconds in found:
        right = sum(one.error_m < RIGHT_M for one in rows)
        cells.append(f"{method} {right}/{len(rows)} in {seconds:.1f} s")
        name = str(rows[0].image) if rows else name
    return f"{name}: {'; '.join(cells)}" if name else "an image of which nothing is known"


def report_lines(document: Mapping[str, Any]) -> list[str]:
    """Everything that `pose_figures` found."""
    if not document["methods"]:
        return ["no image was finished"]
    lines = [f"{document['images']} images; ADD-S strictly under 5, 10, 20 mm, a missing object counts 1 m"]
    lines += _groups(document["methods"])
    lines += _seconds(document["methods"])
    lines += _coverage(document["methods"])
    if document["by_visible_fraction"]:
        lines += ["", *_table(document["by_visible_fraction"], "visible", "of it seen")]
    if document["differences"]:
        lines += ["", *_differences(document["differences"])]
    for method, figures in document["presence"].items():
        lines += ["", method, *presence_lines(figures)]
    return lines


def presence_lines(figures: Mapping[str, Any]) -> list[str]:
    """What `presence_figures` found."""
    lines = [
        f"{figures['asked']} asked for, {figures['absent']} of them absent:"
        f" {figures['false']} found where they are not, {figures['missed']} missed",
        "presence   count  right",
    ]
    return lines + [
        f"{row['presence']:>8.2f}  {row['count']:>6}  {row['right']:>5.2f}" for row in figures["calibration"]
    ]


def _groups(methods: Mapping[str, Any]) -> list[str]:
    rows = [
        {"group": group, "method": _title(method, figures), **errors}
        for method, figures in methods.items()
        for group, errors in figures["rows"].items()
    ]
    order = {group: place for place, group in enumerate(dict.fromkeys(row["group"] for row in rows))}
    return _table(sorted(rows, key=lambda row: order[row["group"]]), "group", "images")


def _title(method: str, figures: Mapping[str, Any]) -> str:
    return f"{method} ({figures['setting']})" if figures["setting"] else method


def _table(rows: Sequence[Mapping[str, Any]], group: str, heading: str) -> list[str]:
    width = max(len(row["method"]) for row in rows)
    first = max(len(heading), *(len(row[group]) for row in rows))
    columns = "objects   <5 mm  <10 mm    95% Wilson  <20 mm     AUC  median mm"
    lines = [f"{heading:<{first}}  {'':<{width}}  {columns}"]
    for row in rows:
        shares = [f"{share:>6.1%}" for share in row["accuracy"].values()]
        low, high = row["right_interval"]
        shares.insert(2, f"{low:>4.0%} to {high:>4.0%}")
        lines.append(
            f"{row[group]:<{first}}  {row['method']:<{width}}  {row['objects']:>7}  {'  '.join(shares)}"
            f"  {row['auc_0_10cm']:>6.1%}  {1000 * row['median_m']:>9.1f}"
        )
    return lines


def _seconds(methods: Mapping[str, Any]) -> list[str]:
    lines = []
    for method, figures in methods.items():
        if figures["seconds_median"] is None:
            continue
        edges = "".join(
            f", {one['right']:.1%} of {one['rests']} {kind} rests right"
            for kind, one in figures["edges"].items()
            if one["rests"]
        )
        timing = f"{figures['seconds_median']:.2f} s an image (most {figures['seconds_most']:.2f})"
        lines.append(f"{_title(method, figures)}: {timing}{edges}")
    return lines


def _coverage(methods: Mapping[str, Any]) -> list[str]:
    lines = []
    for method, figures in methods.items():
        if told := figures["coverage"]:
            inside = ", ".join(f"{share:.0%} in the {level}" for level, share in told["inside"].items())
            lines.append(f"{_title(method, figures)}: of {told['objects']} true centres {inside} regions")
    return lines


def _differences(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    first = rows[0]["first"]
    lines = [f"{first} less the others, share under 10 mm, 95% intervals over images"]
    places = [" ".join(part for part in (row["group"], row["visible"]) if part) for row in rows]
    width, second = max(map(len, places)), max(len(row["second"]) for row in rows)
    for place, row in zip(places, rows, strict=True):
        lines.append(
            f"{place:<{width}}  {row['second']:<{second}}  {row['share']:>+7.1%}"
            f"  ({row['low']:+.1%} to {row['high']:+.1%})"
            f"  {row['objects']:>6} objects, {row['images']} images"
        )
    return lines
