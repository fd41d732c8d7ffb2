"""The run in words: one Markdown page beside the pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.publishing.told_spread import (
    camera_text,
    position_text,
    presence_text,
    rotation_text,
    shares_text,
    undiscovered_text,
    verdict_text,
)
from pipeline.publishing.values import RunValues
from slam.result import SlamResult


def report_markdown(values: RunValues, summary: Mapping[str, Any]) -> str:
    """What was found, how sure it is, and how to read the views.

    Args:
        values: of the run.
        summary: summary.json.
    """
    parts: list[str] = []
    if "parse" in summary:
        parts += _scene(summary["parse"])
    if values.slam is not None:
        parts += _camera(values.slam, summary["slam"])
    if "learn" in summary:
        parts += _shapes(summary["learn"])
    return "\n".join(parts) + "\n"


def _camera(slam: SlamResult, told: Mapping[str, Any]) -> list[str]:
    doubts = camera_text(told), undiscovered_text(told["undiscovered_probability"])
    return [
        "",
        "**Camera**",
        "",
        f"- {told['frames']} frames over {told['length_m']:.2f} m, {told['lost_frames'] or 'none'} lost",
        *(f"- {doubt}" for doubt in doubts if doubt),
        f"- effective number of hypotheses at most {slam.hypotheses.max():.2g};"
        f" {len(slam.log_weights)} trajectories drawn",
        *_paths(slam.path_probabilities),
        "- ellipsoids: 95% regions of positions, of true size; ten times larger as `uncertainty_10x`",
    ]


def _paths(probabilities: NDArray[np.float64]) -> list[str]:
    """One line where several paths explain what was seen."""
    if len(probabilities) == 1:
        return []
    told = ", ".join(f"{probability:.0%}" for probability in probabilities)
    return [
        f"- **{len(probabilities)} paths explain what was seen**, with {told}; the mean is the likeliest's"
    ]


def _scene(parse: Mapping[str, Any]) -> list[str]:
    """The verdict on the spreads, and one line for each object looked for; positions are of its middle."""
    lines = [
        f"**Objects**: {verdict_text(parse)}",
        "",
        "| object | there | position | rotation | poses | rests on |",
        "|---|---|---|---|---|---|",
    ]
    for one in parse["objects"]:
        rests = [
            f"{edge['parent']} {edge['probability']:.0%}"
            for edge in parse["graph"]
            if edge["child"] == one["name"] and edge["probability"] >= 0.005
        ]
        doubt = "" if one["converged"] else "?"
        cells = [one["name"], presence_text(one), position_text(one) + doubt, rotation_text(one)]
        cells += [shares_text(one), ", ".join(rests) or "nothing"]
        lines.append(f"| {' | '.join(cells)} |")
    return [
        *lines,
        *(f"| {one['name']} | {presence_text(one)} | | | | not found |" for one in parse["not_found"]),
        "",
        "- +-: standard deviation over all samples, of the centre and of the orientation; "
        "poses: shares of distinct ones; ?: chains do not agree",
        "- outlines: samples of the posterior; ellipsoid on the pole: 95% region of the centre, of true size",
    ]


def _shapes(learned: Mapping[str, Any]) -> list[str]:
    """One line for each learned shape, and what is wrong with it."""
    lines = [
        "",
        "**Learned shapes**",
        "",
        "| shape | size, mm | voxel, mm | surface seen | inferred | never seen |",
        "|---|---|---|---|---|---|",
    ]
    warnings = []
    for name, shape in learned.items():
        size = " x ".join(f"{1000 * extent:.0f}" for extent in shape["size_m"] or ())
        surface = shape["surface"] or {"seen": math.nan, "inferred": math.nan, "never_seen": math.nan}
        shares = [f"{surface[state]:.0%}" for state in ("seen", "inferred", "never_seen")]
        lines.append(f"| {name} | {size} | {1000 * shape['pitch_m']:.0f} | {' | '.join(shares)} |")
        warnings += [f"- **{name}: {warning}**" for warning in shape["warnings"]]
    return [*lines, "", *warnings]
