"""The one place that imports matplotlib and writes its figures."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.atomic import atomic_path
from pipeline.errors import PipelineError

FORMATS = (".png", ".svg")
DOTS_PER_INCH = 100
METADATA: dict[str, dict[str, Any]] = {".png": {"Software": None}, ".svg": {"Date": None, "Creator": None}}
"""Clocks and versions are left out: equal figures give equal files."""


def panels(rows: int, columns: int, width: float, height: float) -> tuple[Any, list[list[Any]]]:
    """A figure of so many axes.

    Args:
        rows: of axes.
        columns: of axes.
        width: of each in inches.
        height: of each in inches.

    Returns:
        The figure, and its axes by row and column.
    """
    import matplotlib
    from matplotlib.figure import Figure

    matplotlib.rcParams["svg.hashsalt"] = "voxscene"
    figure = Figure(figsize=(columns * width, rows * height), layout="constrained", dpi=DOTS_PER_INCH)
    return figure, figure.subplots(rows, columns, squeeze=False).tolist()


def write_figure(figure: Any, paths: Sequence[Path]) -> None:
    """Write a figure in the format of each path's suffix, whole or not at all.

    Raises:
        PipelineError: a format is unknown, or a file cannot be written.
    """
    for path in paths:
        suffix = path.suffix.lower()
        if suffix not in FORMATS:
            raise PipelineError(f"{path}: figures are written as {', '.join(FORMATS)}")
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as partial:
            partial.write_bytes(figure_bytes(figure, suffix))


def figure_bytes(figure: Any, suffix: str) -> bytes:
    """A figure as the content of a file with one of the suffixes of `FORMATS`."""
    content = io.BytesIO()
    figure.savefig(content, format=suffix[1:], metadata=METADATA[suffix])
    return content.getvalue()
