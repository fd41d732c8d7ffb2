"""What rows of `bench shapes` say together: means, calibration, falls and growth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from pipeline.benchmarks.shape_row import ShapeRow
from pipeline.evaluation.calibration import calibration, reliability

RESAMPLES = 1000
TOLERATED_FALL = 0.005


def summary(
    rows: Sequence[ShapeRow], by_pitch: Sequence[Mapping[str, float]], pitch_m: float
) -> dict[str, Any]:
    """Everything that is printed, as one document."""
    figures = [row.figures for row in rows]
    true = [row for row in figures if row["poses"] == "true" and "failed" not in row]
    pitches, seconds = ([one[key] for one in by_pitch] for key in ("pitch_m", "seconds"))
    grown = exponent([1 / pitch for pitch in pitches], seconds)
    views = exponent([row["views"] for row in true], [row["seconds"] for row in true])
    return {
        "pitch_m": pitch_m,
        "rows": figures,
        "means": means(figures),
        "calibration": pooled_calibration(rows),
        "falls": falls(figures),
        "growth": {"by_pitch": list(by_pitch), "pitch_exponent": grown, "views_exponent": views},
    }


def means(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Means over all objects, and over those with thick and with thin walls, by views and poses."""
    found = []
    for views, poses in _groups(rows):
        for walls, kept in (("all", (True, False)), ("thick", (False,)), ("thin", (True,))):
            part = [row for row in _group(rows, views, poses) if row["thin"] in kept]
            if part:
                about = {"views": views, "poses": poses, "walls": walls, "objects": len(part)}
                found.append({**about, **_mean(part)})
    return found


def pooled_calibration(rows: Sequence[ShapeRow]) -> list[dict[str, Any]]:
    """Scores of every method, peers at their best setting, on the same seen voxels of all objects."""
    figures = [row.figures for row in rows]
    found = []
    for views, poses in _groups(figures):
        best = _best_settings(_group(figures, views, poses))
        chosen = {f"{peer}: {setting}" for peer, (setting, _) in best.items()}
        part = [row for row in rows if (row.figures["views"], row.figures["poses"]) == (views, poses)]
        for method in dict.fromkeys(method for row in part for method in row.scored):
            if ": " in method and method not in chosen:
                continue
            phi, truth = np.concatenate([row.scored[method] for row in part if method in row.scored], axis=1)
            scores = asdict(calibration(phi, truth > 0.5))
            table = reliability(phi, truth > 0.5)
            about = {"views": views, "poses": poses, "method": method}
            found.append({**about, **scores, "reliability": table})
    return found


def falls(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Objects whose solid agreement falls by more than is tolerated from fewer views to more."""
    found = []
    for name, poses in sorted({(row["object"], row["poses"]) for row in rows}):
        series = sorted(
            (row["views"], row["solid"]) for row in rows if (row["object"], row["poses"]) == (name, poses)
        )
        for index, (views, solid) in enumerate(series):
            fall = max((earlier for _, earlier in series[:index]), default=solid) - solid
            if fall > TOLERATED_FALL:
                found.append({"object": name, "poses": poses, "views": views, "fall": fall})
    return found


def exponent(sizes: Sequence[float], seconds: Sequence[float]) -> float | None:
    """Power of the size with which the time grows, by least squares of the logarithms."""
    if len(set(sizes)) < 2:
        return None
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def _groups(rows: Sequence[Mapping[str, Any]]) -> list[tuple[int, str]]:
    """Numbers of views and kinds of poses, in the order in which they appear."""
    return list(dict.fromkeys((row["views"], row["poses"]) for row in rows))


def _group(rows: Sequence[Mapping[str, Any]], views: int, poses: str) -> list[Mapping[str, Any]]:
    return [row for row in rows if (row["views"], row["poses"]) == (views, poses)]


def _mean(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    figures: dict[str, Any] = {
        key: float(np.mean([row[key] for row in rows]))
        for key in ("solid", "shell", "observed", "ceiling", "ratio", "reachable", "touched", "seconds")
    }
    for key in ("wall_mm", "true_wall_mm"):
        known = [row[key] for row in rows if row[key] is not None]
        figures[key] = float(np.mean(known)) if known else None
    draws = np.random.default_rng(0).integers(len(rows), size=(RESAMPLES, len(rows)))
    solid = np.asarray([row["solid"] for row in rows])[draws].mean(axis=1)
    figures["solid_95"] = [float(value) for value in np.quantile(solid, [0.025, 0.975])]
    best = _best_settings(rows)
    return {
        **figures,
        "peers": {peer: {"solid": solid, "setting": name} for peer, (name, solid) in best.items()},
    }


def _best_settings(rows: Sequence[Mapping[str, Any]]) -> dict[str, tuple[str, float]]:
    """The setting of every peer with the best mean over the rows, and that mean."""
    learned = [row["peers"] for row in rows if row["peers"]]
    found = {}
    for peer, settings in (learned[0] if learned else {}).items():
        scores = {name: float(np.mean([one[peer][name]["solid"] for one in learned])) for name in settings}
        best = max(scores, key=lambda name: scores[name])
        found[peer] = best, scores[best]
    return found
