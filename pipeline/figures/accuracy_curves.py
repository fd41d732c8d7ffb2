"""Accuracy over ADD-S thresholds by kind of image and shape, a line for each method (section E)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.benchmarks.pose_rows import Judged
from pipeline.errors import PipelineError
from pipeline.figures.canvas import panels, write_figure

LARGEST_M = 0.03
COLOURS = {"voxscene": "tab:green", "3DP3* (fixed graph)": "tab:orange"}
"""Of our columns; others take matplotlib's cycle."""
OTHERS = ("tab:cyan", "tab:blue", "tab:purple", "tab:gray", "tab:pink", "tab:olive", "tab:red", "tab:brown")


def accuracy_curve(errors_m: Sequence[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Thresholds from 0 to 3 cm and the share of errors strictly under each, as corners of a staircase."""
    errors = np.sort(np.asarray(errors_m, np.float64))
    errors = errors[errors < LARGEST_M]
    steps = np.arange(1, len(errors) + 1) / max(len(errors_m), 1)
    thresholds = np.concatenate([[0.0], errors, [LARGEST_M]])
    return thresholds, np.concatenate([[0.0], steps, steps[-1:] if len(steps) else [0.0]])


def method_colours(methods: Sequence[str]) -> dict[str, str]:
    """A colour for every method, ours always the same."""
    others = [method for method in methods if method not in COLOURS]
    return COLOURS | {method: OTHERS[place % len(OTHERS)] for place, method in enumerate(others)}


def draw_curves(judged: Sequence[Judged], path: Path) -> None:
    """Write one figure with a panel for each kind (rows) and shape (columns).

    Raises:
        PipelineError: there is nothing to draw, or the file cannot be written.
    """
    if not judged:
        raise PipelineError("no image was judged, so there are no curves to draw")
    kinds = list(dict.fromkeys(one.kind for one in judged))
    shapes = sorted({one.shape for one in judged})
    methods = list(dict.fromkeys(one.method for one in judged))
    colours = method_colours(methods)
    figure, axes = panels(len(kinds), len(shapes), 2.6, 2.2)
    for kind, row in zip(kinds, axes, strict=True):
        for shape, axis in zip(shapes, row, strict=True):
            own = [one for one in judged if (one.kind, one.shape) == (kind, shape)]
            for method in reversed(methods):  # ours over the others
                errors = [one.error_m for one in own if one.method == method]
                thresholds, shares = accuracy_curve(errors)
                axis.step(
                    1000 * thresholds, shares, where="post", color=colours[method], label=method, lw=1.4
                )
            count = len({(one.image, one.name) for one in own})
            axis.set(xlim=(0, 1000 * LARGEST_M), ylim=(0, 1.02), title=f"{shape}, {kind} ({count})")
            axis.title.set_fontsize(8)
            axis.tick_params(labelsize=7)
            axis.grid(alpha=0.3)
    axes[-1][0].set_xlabel("ADD-S threshold (mm)", fontsize=8)
    axes[0][0].set_ylabel("share under it", fontsize=8)
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4), fontsize=8)
    write_figure(figure, [path])
