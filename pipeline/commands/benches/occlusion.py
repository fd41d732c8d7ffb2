"""`voxscene bench occlusion`: presence of an object that nobody sees."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline.options import Common, OutputFile, common_options, only_for

if TYPE_CHECKING:
    from pipeline.benchmarks.occlusion import OcclusionRow


@click.command(name="occlusion")
@click.option(
    "--scenes", type=click.IntRange(min=0), default=0, show_default=True, help="More, with the box anywhere."
)
@click.option(
    "--drawn",
    type=click.IntRange(min=1),
    help="Instead, so many scenes drawn from the prior, mug and all: is what is told so often so?",
)
@click.option(
    "--draws",
    type=click.IntRange(1024, 10**8),
    default=2**19,
    show_default=True,
    help="Poses of the mug that are drawn in each scene.",
)
@click.option(
    "--width", type=click.IntRange(32, 1024), default=64, show_default=True, help="Of images, pixels."
)
@click.option("--csv", "csv_path", type=OutputFile(), help="Write a row for each scene.")
@common_options(computes=True)
def command(
    common: Common, scenes: int, drawn: int | None, draws: int, width: int, csv_path: Path | None
) -> None:
    """Is a mug there that no pixel shows? The supplement's figure 7.

    A box turned, wide and closer, both objects there with probability 0.9: the exact probability of the mug
    beside the share of the volume that is hidden, by importance sampling over its prior poses.
    """
    from pipeline.benchmarks.occlusion import (
        drawn_figures,
        figures,
        measure_drawn_scenes,
        measure_occlusion,
        write_rows,
    )
    from pipeline.quiet_stdout import stdout_to_stderr

    if drawn:
        only_for("a bench without --drawn", "scenes")
    with common.progress("occlusion", "scenes") as progress, stdout_to_stderr():
        if drawn:
            rows = measure_drawn_scenes(common.seed, drawn, width, draws, progress)
        else:
            rows = measure_occlusion(common.seed, scenes, width, draws, progress)
    document = drawn_figures(rows) if drawn else figures(rows)
    common.report(document, [_drawn_line(document, drawn)] if drawn else _lines(document, rows))
    if csv_path:
        write_rows(csv_path, rows)


def _lines(document: dict[str, Any], rows: list[OcclusionRow]) -> list[str]:
    lines = ["scene    hidden   P(mug)           m        draws  P(box)  seconds"]
    lines += [
        f"{row.scene:8s} {row.hidden_fraction:6.1%}  {row.mug:.4f} ± {row.mug_error:.4f}"
        f"  {row.mean_ratio:.4f}  {row.effective_draws:7.0f}  {row.box:.4f}  {row.seconds:.1f}"
        for row in rows
    ]
    return [*lines, f"turned < wide < closer: {'yes' if document['in_order'] else 'no'}"]


def _drawn_line(document: dict[str, Any], scenes: int) -> str:
    return (
        f"{scenes} scenes: the mug is in {document['there']}, {document['presence_sum']:.1f} told;"
        f" ECE {document['ece']:.3f}, largest standard error {document['largest_error']:.3f}"
    )
