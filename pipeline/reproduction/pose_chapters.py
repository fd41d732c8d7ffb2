"""Sections D to H: challenging images, accuracy of poses with curves, and overlays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipeline.benchmarks.pose_figures import pose_figures
from pipeline.benchmarks.pose_images import PoseImage
from pipeline.benchmarks.pose_methods import OURS, Method, registrations
from pipeline.benchmarks.pose_rows import write_csv
from pipeline.benchmarks.pose_sources import PoseSource, challenging_images
from pipeline.benchmarks.poses import collected, judged_images, tuned
from pipeline.figures.accuracy_curves import draw_curves
from pipeline.figures.canvas import panels, write_figure
from pipeline.figures.overlays import Outline, draw_overlay
from pipeline.figures.pose_sheets import draw_sheets
from pipeline.peers.registration import settings
from pipeline.report.page import Page
from pipeline.reproduction.request import Request
from pipeline.synthesis.challenging_kinds import KINDS
from pipeline.synthesis.challenging_scene import ChallengingScene

SHOWN = 4
"""Images of each kind in the picture of the set."""


def challenging_source(request: Request) -> PoseSource:
    """The set's images, made in memory."""
    return challenging_images(request.shapes, tuple(KINDS), request.images, ChallengingScene(), request.seed)


def image_chapter(request: Request, page: Page) -> None:
    """D: what the images look like."""
    source = challenging_source(request)
    page.chapter("D. Challenging images")
    page.text(
        "One object alone, stacked ones, cut by the image's border, hidden by another: the kinds are those "
        "of the paper as it is remembered, for the supplement's list is lost; placement, camera and sensor "
        "are our own."
    )
    page.listing(request.command("synth", "challenging", "OUT", "--images", str(request.images)))
    figure, axes = panels(len(KINDS), SHOWN, 2.8, 2.2)
    for kind, row in zip(KINDS, axes, strict=True):
        places = [key for key in source.places() if key.kind == kind][:SHOWN]
        for axis in row[len(places) :]:
            axis.set_axis_off()
        for key, axis in zip(places, row, strict=False):
            image = source.image(key)
            draw_overlay(axis, image.frame, image.intrinsics, _true_outlines(image), crop=False)
            axis.set_title(_seen(image), fontsize=7)
    path = request.out / "figures" / "challenging.png"
    write_figure(figure, [path])
    page.pictures({"the first images of each kind, true outlines in white": path.read_bytes()})


def pose_chapters(
    request: Request, page: Page, source: PoseSource, title: str, name: str, images: Sequence[str]
) -> None:
    """E to H: errors in a source's images, curves, and overlays of the most different and the worst.

    Args:
        request: what was asked for.
        page: it grows by the chapters.
        source: of the images.
        title: of the first chapter.
        name: of the files.
        images: the options of `bench poses` that name the source.
    """
    methods = _methods(request)
    found = judged_images(source, methods, request.executors, request.at_once, request.rows, request.progress)
    judged, seconds = collected(found)
    document = pose_figures(judged, seconds)
    page.chapter(title)
    page.text("ADD-S strictly under a threshold; a missing object counts one metre; all objects are judged.")
    page.listing(request.command("bench", "poses", *images, "--against", ",".join(request.peers)))
    _tables(page, document)
    write_csv(request.out / "tables" / f"{name}.csv", judged)
    curves = request.out / "figures" / f"{name}_curves.png"
    draw_curves(judged, curves)
    draw_curves(judged, curves.with_suffix(".svg"))
    page.pictures({"accuracy over ADD-S thresholds": curves.read_bytes()})
    sheets = draw_sheets(judged, source, request.out / "figures" / name)
    page.section("Poses on the images")
    page.text(
        "Truth white, ours green, the ablation orange, hidden edges dotted. Picked by rule: of each "
        "shape the two images on which ADD-S of the second method less that of the first is largest, and "
        "the two on which it is least; then the worst."
    )
    page.pictures(
        {path.stem.replace("_", " "): path.read_bytes() for path in sheets if path.suffix == ".png"}
    )


def _methods(request: Request) -> list[Method]:
    ours: Sequence[Method] = [one.of(request.seed, 0) for one in OURS]
    peers = [
        tuned(method, request.shapes, list(settings()[peer]))
        for peer in request.peers
        for method in registrations(peer)
    ]
    return [*ours, *peers]


def _tables(page: Page, document: dict[str, Any]) -> None:
    header = ("images", "method", "objects", "< 5 mm", "< 10 mm", "< 20 mm", "AUC", "median mm")
    rows = [
        (group, method, *_cells(errors))
        for method, figures in document["methods"].items()
        for group, errors in figures["rows"].items()
    ]
    page.table(header, sorted(rows, key=lambda row: row[0] != "all"))
    seen = [(row["visible"], row["method"], *_cells(row)) for row in document["by_visible_fraction"]]
    page.section("By how much of the object is seen")
    page.table(("seen", *header[1:]), seen)
    if document["differences"]:
        page.section("Differences, paired, with 95% intervals over images")
        page.table(
            ("images", "less", "share under 10 mm", "95% interval", "objects"),
            [_difference(row) for row in document["differences"]],
        )


def _difference(row: dict[str, Any]) -> tuple[str, ...]:
    place = " ".join(part for part in (row["group"], row["visible"]) if part)
    reach = f"{row['low']:+.1%} to {row['high']:+.1%}"
    return place, row["second"], f"{row['share']:+.1%}", reach, str(row["objects"])


def _cells(errors: dict[str, Any]) -> tuple[str, ...]:
    shares = [f"{share:.1%}" for share in errors["accuracy"].values()]
    return str(errors["objects"]), *shares, f"{errors['auc_0_10cm']:.1%}", f"{1000 * errors['median_m']:.1f}"


def _true_outlines(image: PoseImage) -> list[Outline]:
    return [
        Outline(
            mesh=image.meshes[one.shape],
            camera_from_mesh=np.asarray(image.camera_from_world @ one.world_from_object, np.float64),
            colour="white",
            label="truth",
        )
        for one in image.objects
    ]


def _seen(image: PoseImage) -> str:
    shares = ", ".join(f"{one.name} {one.visible_fraction or 0:.0%}" for one in image.objects)
    return f"{image.key.kind}: {shares}"
