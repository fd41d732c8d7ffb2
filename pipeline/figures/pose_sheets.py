"""Sheets of images with the poses of several methods, picked by rule (supplement, figures 4 to 6)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.benchmarks.pose_images import PoseImage
from pipeline.benchmarks.pose_rows import Judged
from pipeline.benchmarks.pose_sources import PoseSource
from pipeline.figures.accuracy_curves import method_colours
from pipeline.figures.canvas import panels, write_figure
from pipeline.figures.overlays import Outline, draw_overlay

EACH = 2
"""Images of largest and of least difference on a shape's sheet."""
WORST = 10
MOST_ERROR_M = 0.1
"""Larger errors count as this when differences are compared."""
TRUTH = "white"
PICTURE_INCHES = 3.2


def draw_sheets(judged: Sequence[Judged], source: PoseSource, folder: Path) -> list[Path]:
    """Write a sheet for each shape, of the first two methods, and one of the first method's worst.

    Args:
        judged: rows of all methods.
        source: of their images.
        folder: for NAME.png and NAME.svg.

    Returns:
        The files.

    Raises:
        PipelineError: a file cannot be written.
    """
    methods = list(dict.fromkeys(one.method for one in judged))
    paths = []
    if len(methods) > 1:
        for shape in sorted({one.shape for one in judged}):
            picked = picked_by_difference(judged, shape, methods[0], methods[1])
            title = f"{shape}: largest and least ADD-S of {methods[1]} less that of {methods[0]}"
            paths += _draw(picked, judged, source, folder / f"difference_{shape}", title)
    worst = picked_worst(judged, methods[0]) if methods else []
    paths += _draw(worst, judged, source, folder / "worst", f"the {len(worst)} largest ADD-S of {methods[0]}")
    return paths


def picked_by_difference(judged: Sequence[Judged], shape: str, first: str, second: str) -> list[Judged]:
    """The first method's rows of the two images on which it gains most on the second, and loses most."""
    others = {
        (one.image, one.name): one.error_m for one in judged if (one.method, one.shape) == (second, shape)
    }
    rows = [
        one for one in judged if (one.method, one.shape) == (first, shape) and (one.image, one.name) in others
    ]

    def gain(one: Judged) -> float:
        return min(others[one.image, one.name], MOST_ERROR_M) - min(one.error_m, MOST_ERROR_M)

    ordered = sorted(rows, key=lambda one: (-gain(one), one.image, one.name))
    return ordered if len(ordered) <= 2 * EACH else ordered[:EACH] + ordered[-EACH:]


def picked_worst(judged: Sequence[Judged], method: str) -> list[Judged]:
    """The method's rows of largest error, worst first."""
    rows = [one for one in judged if one.method == method]
    return sorted(rows, key=lambda one: (-one.error_m, one.image, one.name))[:WORST]


def _draw(
    picked: Sequence[Judged], judged: Sequence[Judged], source: PoseSource, stem: Path, title: str
) -> list[Path]:
    if not picked:
        return []
    columns = min(len(picked), 5)
    rows = -(-len(picked) // columns)
    figure, axes = panels(rows, columns, PICTURE_INCHES, 1.15 * PICTURE_INCHES)
    figure.suptitle(title, fontsize=10)
    colours = method_colours(list(dict.fromkeys(one.method for one in judged)))
    flat = [axis for row in axes for axis in row]
    for axis in flat[len(picked) :]:
        axis.set_axis_off()
    for one, axis in zip(picked, flat, strict=False):
        image = source.image(one.image)
        answers = [other for other in judged if (other.image, other.name) == (one.image, one.name)]
        draw_overlay(axis, image.frame, image.intrinsics, _outlines(image, one.name, answers, colours))
        axis.set_title(_caption(one, answers), fontsize=6)
    labels: dict[str, Any] = {}
    for axis in flat:
        handles, names = axis.get_legend_handles_labels()
        labels |= dict(zip(names, handles, strict=True))
    legend = figure.legend(
        list(labels.values()), list(labels), loc="outside lower center", ncols=4, fontsize=8
    )
    legend.get_frame().set_facecolor("lightgray")
    paths = [stem.with_name(f"{stem.name}{suffix}") for suffix in (".png", ".svg")]
    write_figure(figure, paths)
    return paths


def _outlines(
    image: PoseImage, name: str, answers: Sequence[Judged], colours: dict[str, str]
) -> list[Outline]:
    """The truth and every method's estimate of one object."""
    (true,) = (one for one in image.objects if one.name == name)
    mesh = image.meshes[true.shape]
    pose = image.camera_from_world @ true.world_from_object
    outlines = [Outline(mesh=mesh, camera_from_mesh=pose, colour=TRUTH, label="truth")]
    for answer in reversed(answers):  # ours over the others
        estimate = answer.camera_from_object
        if estimate is not None:
            outlines.append(
                Outline(
                    mesh=mesh, camera_from_mesh=estimate, colour=colours[answer.method], label=answer.method
                )
            )
    return outlines


def _caption(one: Judged, answers: Sequence[Judged]) -> str:
    seen = "" if one.visible_fraction is None else f", {one.visible_fraction:.0%} of it seen"
    lines = [f"{one.name} in {one.image}{seen}"]
    for answer in answers:
        found = "missing" if answer.estimate is None else f"{1000 * answer.error_m:.1f} mm"
        score = "" if answer.score is None else f", presence {answer.score:.2f}"
        lines.append(f"{answer.method}: {found}{score}")
    return "\n".join(lines)
