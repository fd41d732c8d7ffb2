"""The page of `voxscene reproduce`: a chapter for each section of the supplement that was asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from pipeline.benchmarks.occlusion import figures, measure_occlusion, write_rows
from pipeline.benchmarks.poses import RemainingTime
from pipeline.benchmarks.sampler import document_of, measure_sampler
from pipeline.errors import PipelineError
from pipeline.machine import machine
from pipeline.report.page import Page
from pipeline.reproduction.pose_chapters import challenging_source, image_chapter, pose_chapters
from pipeline.reproduction.request import Request
from pipeline.reproduction.shape_chapter import shape_chapter

SAMPLER_MOVES = 2_000_000
OCCLUSION_WIDTH_PX, OCCLUSION_DRAWS = 64, 2**18


def reproduce(request: Request, sections: Sequence[str]) -> Page:
    """Measure what was asked for; whatever is done is kept, so that the same command goes on.

    Args:
        request: what is measured.
        sections: letters of `CHAPTERS`, in any order.

    Raises:
        PipelineError: a part cannot be measured.
    """
    about = machine()
    versions = ", ".join(f"{name} {version}" for name, version in dict(about["versions"]).items())  # pyright: ignore
    page = Page(
        "The supplement's experiments",
        f"seed {request.seed}; {about['cores']} cores, {about['processor']}; {versions}",
    )
    for letter, chapter in CHAPTERS.items():
        if letter in sections:
            request.say(f"section {letter}")
            remaining = RemainingTime(request.say, request.progress)  # sections differ in what an image costs
            chapter(replace(request, progress=remaining), page)
    return page


def _poses(request: Request, page: Page) -> None:
    source, images = challenging_source(request), ("--challenging", str(request.images))
    pose_chapters(request, page, source, "E, G, H. Poses in challenging images", "challenging", images)


def _real_images(request: Request, page: Page) -> None:
    if request.data is None:
        raise PipelineError("section F needs a data set: --data BOP_ROOT, or leave F out of --only")
    images = ("--data", str(request.data.root), "--split", request.data.split)
    pose_chapters(request, page, request.data, "F, G, H. Poses in real images", "data", images)


def _occlusion(request: Request, page: Page) -> None:
    rows = measure_occlusion(request.seed, 0, OCCLUSION_WIDTH_PX, OCCLUSION_DRAWS, request.progress)
    write_rows(request.out / "tables" / "occlusion.csv", rows)
    page.chapter("L. A mug that nobody sees")
    in_order = "yes" if figures(rows)["in_order"] else "no"
    page.text(
        "Its probability where a box is turned, wide, or closer, before which both are there with 0.9; the "
        f"share of the volume that is hidden beside it. In the supplement's order: {in_order}."
    )
    about = ("--width", str(OCCLUSION_WIDTH_PX), "--draws", str(OCCLUSION_DRAWS))
    page.listing(request.command("bench", "occlusion", *about, meshes=False))
    page.table(
        ("scene", "hidden", "probability of the mug", "standard error"),
        [(row.scene, f"{row.hidden_fraction:.1%}", f"{row.mug:.4f}", f"{row.mug_error:.4f}") for row in rows],
    )


def _sampler(request: Request, page: Page) -> None:
    document = document_of(measure_sampler(request.seed, SAMPLER_MOVES, request.progress))
    page.chapter("O. The sampler of scene graphs")
    page.text("Total variation of visited scene graphs from the enumerated posterior.")
    page.listing(request.command("bench", "sampler", "--moves", str(SAMPLER_MOVES), meshes=False))
    page.table(
        ("objects", "graphs", "without data", "independent draws", "with data"),
        [
            (
                count,
                str(document["trees"][count]),
                f"{distance:.4f}",
                f"{document['independent_draws'][count]:.4f}",
                f"{document['with_data'][count]:.4f}",
            )
            for count, distance in document["total_variation"].items()
        ],
    )


CHAPTERS: Mapping[str, Callable[[Request, Page], None]] = {
    "C": shape_chapter,
    "D": image_chapter,
    "E": _poses,
    "F": _real_images,
    "L": _occlusion,
    "O": _sampler,
}
"""By the supplement's letters; pictures (G, H) stand with the poses of E and F."""
