"""`voxscene bench air`: things on a table from one colour image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pipeline.options import Common, OutputFile, common_options, goes_on, image_size, only_for


@click.command(name="air")
@click.option("--scenes", type=click.IntRange(min=1), default=40, show_default=True)
@click.option("--size", metavar="WIDTHxHEIGHT", default="64x64", show_default=True, help="Image size.")
@click.option(
    "--lamp",
    type=click.Choice(["known", "any", "other"]),
    default="known",
    show_default=True,
    help="`any`: each scene has its own, which the search finds; `other`: it takes the usual one for it.",
)
@click.option(
    "--csv",
    "csv_path",
    type=OutputFile(),
    help="A row for each scene as it is done; scenes that the file holds already are not run again, and rows"
    " of another --size, --lamp or program are refused.",
)
@click.option(
    "--lattice",
    type=click.IntRange(min=1),
    metavar="IMAGES",
    help="Instead: chains against the exact sum over all 41,905 scenes of a world of few states, on so many.",
)
@common_options(computes=True)
def command(
    common: Common, scenes: int, size: str, lamp: str, csv_path: Path | None, lattice: int | None
) -> None:
    """Number, kind and place of 0 to 3 things from one colour image.

    Balls, cubes, cylinders and mugs of unknown colour on a plain table, rendered by Embree with mixed
    silhouettes and noise; the camera is known, no depth, no training. The scenes are numbered from --seed
    on. Set-up is told apart.
    """
    from pipeline.quiet_stdout import stdout_to_stderr

    if lattice:
        only_for("a bench without --lattice", "scenes", "size", "lamp", "csv_path")
        from pipeline.benchmarks.air_lattice import lattice_lines, measure_lattice

        with common.progress("air", "images") as progress, stdout_to_stderr():
            summed = measure_lattice(lattice, common.seed, progress)
        common.report(summed, lattice_lines(summed))
        return
    from pipeline.benchmarks.air import measure_air

    if csv_path:
        goes_on()
    with common.progress("air", "scenes") as progress, stdout_to_stderr():
        document = measure_air(common.seed, scenes, image_size(size), lamp, csv_path, progress)
    common.report(document, _lines(document))


def _lines(document: dict[str, Any]) -> list[str]:
    def share(name: str) -> str:
        value = document[name]
        return "-" if value is None else f"{100 * value:.1f}%"

    def number(name: str, scale: float, unit: str) -> str:
        value = document[name]
        return "-" if value is None else f"{scale * value:.2f} {unit}"

    def interval(name: str) -> str:
        low, high = document[f"{name}_95"] or (0.0, 1.0)
        return f"{share(name)} ({100 * low:.1f} to {100 * high:.1f})"

    missed = ", ".join(map(str, document["missed_by_search"])) or "none"
    return [
        f"{document['scenes']} scenes, set up in {document['set_up_s']:.1f} s",
        f"count right, 95% Wilson: {interval('count_right')}; where every thing shows 12 pixels: "
        f"{interval('count_right_all_seen')} of {document['scenes_all_seen']}",
        f"kinds right where the count is: {share('kinds_right_where_count_is')}",
        f"places of {document['places']}: median {number('place_median_m', 1e3, 'mm')}, "
        f"95% {number('place_95_m', 1e3, 'mm')}",
        f"yaw of mugs: median {number('mug_yaw_median_rad', 57.29578, 'degrees')}",
        f"p(N): mean of the most probable {share('count_told')}, right {share('count_told_right')}, "
        f"calibration error {document['count_ece']:.3f}",
        f"scores as high as the truth less 2 nats: {share('found_at_least_truth')}; below: {missed}",
        f"seconds a frame: median {document['seconds_median']:.2f}, 95% {document['seconds_95']:.2f}; "
        f"of one core {document['core_seconds_median']:.2f}, 95% {document['core_seconds_95']:.2f}",
    ]
