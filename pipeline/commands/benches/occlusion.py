"""`voxscene bench occlusion`: presence of an object that nobody sees."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.options import AnyPath, Common, common_options


@click.command(name="occlusion")
@click.option(
    "--scenes", type=click.IntRange(min=0), default=0, show_default=True, help="More, with the box anywhere."
)
@click.option(
    "--draws",
    type=click.IntRange(1024, 10**8),
    default=2**18,
    show_default=True,
    help="Prior poses of the mug in each scene.",
)
@click.option(
    "--width", type=click.IntRange(32, 1024), default=64, show_default=True, help="Of images, pixels."
)
@click.option("--csv", "csv_path", type=AnyPath(dir_okay=False), help="Write a row for each scene.")
@common_options()
def command(common: Common, scenes: int, draws: int, width: int, csv_path: Path | None) -> None:
    """Is a mug there that no pixel shows? The supplement's figure 7.

    A box turned, wide and closer, both objects there with probability 0.9: the exact probability of the mug
    beside the share of the volume that is hidden, by importance sampling over its prior poses.
    """
    from pipeline.benchmarks.occlusion import figures, measure_occlusion, write_rows
    from pipeline.quiet_stdout import stdout_to_stderr

    with common.progress("occlusion", "scenes") as progress, stdout_to_stderr():
        rows = measure_occlusion(common.seed, scenes, width, draws, progress)
    if csv_path:
        write_rows(csv_path, rows)
    document = figures(rows)
    lines = ["scene    hidden   P(mug)           m        draws  P(box)  seconds"]
    lines += [
        f"{row.scene:8s} {row.hidden_fraction:6.1%}  {row.mug:.4f} ± {row.mug_error:.4f}"
        f"  {row.mean_ratio:.4f}  {row.effective_draws:7.0f}  {row.box:.4f}  {row.seconds:.1f}"
        for row in rows
    ]
    lines.append(f"turned < wide < closer: {'yes' if document['in_order'] else 'no'}")
    common.report(document, lines)
