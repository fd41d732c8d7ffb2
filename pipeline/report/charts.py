"""Charts as PNG pictures: values over time, and paths seen from the side that shows most of them."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#1f5fa8", "#c65f12", "#3d8b40", "#8a4fa3", "#8c6d31", "#c2347a")
"""Of the series in turn."""
GREY = "#777777"
SIZE_IN = (5.0, 2.6)
PATH_IN = (5.0, 4.0)
DOTS_PER_INCH = 110

Points = NDArray[np.float64]


def lines(
    x: Points, series: Mapping[str, Points], x_label: str, y_label: str, *, marked: Points | None = None
) -> bytes:
    """Curves over one axis.

    Args:
        x: (N,) of every series.
        series: (N,) values by name, NaN where there are none.
        x_label: with its unit.
        y_label: with its unit.
        marked: (M,) places on the axis to be shaded, such as lost frames.
    """
    figure, axes = _new(SIZE_IN)
    for (name, values), colour in zip(series.items(), _colours(len(series)), strict=True):
        axes.plot(x, values, color=colour, linewidth=1.2, label=name)
    for place in [] if marked is None else marked:
        axes.axvline(place, color="#d03020", alpha=0.25, linewidth=1.0)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    if all(np.nanmin(values, initial=0.0) >= 0 for values in series.values()):
        axes.set_ylim(bottom=0)
    if len(series) > 1:
        axes.legend(frameon=False, fontsize=8)
    return _png(figure)


def paths(named: Mapping[str, Points]) -> bytes:
    """Paths (N, 3) in metres, seen along the direction in which the first of them extends least.

    The first, the one to compare with, is grey.
    """
    from matplotlib.ticker import MaxNLocator

    across = widest_plane(next(iter(named.values())))
    figure, axes = _new(PATH_IN)
    for (name, points), colour in zip(named.items(), (GREY, *_colours(len(named) - 1)), strict=True):
        flat = points @ across.T
        axes.plot(*flat.T, color=colour, linewidth=1.4, label=name)
        axes.plot(*flat[0], "o", color=colour, markersize=4)
    axes.set_aspect("equal", adjustable="datalim")
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.set_xlabel("m")
    axes.set_ylabel("m")
    if len(named) > 1:
        axes.legend(frameon=False, fontsize=8)
    return _png(figure)


def cloud(points_m: Points, rgb: NDArray[np.uint8] | None, path_m: Points | None) -> bytes:
    """Points (N, 3) in a camera's frame seen from above (x to the right, z away), with a path (T, 3)."""
    figure, axes = _new(PATH_IN)
    high_first = np.argsort(-points_m[:, 1])
    shown = points_m[high_first]
    colours = GREY if rgb is None else rgb[high_first] / 255
    axes.scatter(shown[:, 0], shown[:, 2], s=0.3, c=colours, linewidths=0, rasterized=True)
    if path_m is not None:
        axes.plot(path_m[:, 0], path_m[:, 2], color=COLOURS[1], linewidth=1.6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, m")
    axes.set_ylabel("z, m")
    return _png(figure)


def widest_plane(points_m: Points) -> Points:
    """Two orthonormal directions (2, 3) in which points (N, 3) extend most (principal components)."""
    _, _, directions = np.linalg.svd(points_m - points_m.mean(axis=0), full_matrices=True)
    return directions[:2]


def _colours(count: int) -> Sequence[str]:
    return [COLOURS[number % len(COLOURS)] for number in range(count)]


def _new(size_in: tuple[float, float]) -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size_in, dpi=DOTS_PER_INCH, layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#e3e6ea", linewidth=0.6)
    axes.set_axisbelow(True)
    return figure, axes


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
