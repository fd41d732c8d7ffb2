"""`voxscene bench sampler`: the structure sampler against enumeration."""

from __future__ import annotations

from typing import Any

import click

from pipeline.options import Common, common_options

MOVES = 2_000_000


@click.command(name="sampler")
@click.option(
    "--moves", type=click.IntRange(min=1000), default=MOVES, show_default=True, help="Of all chains together."
)
@common_options(computes=True)
def command(common: Common, moves: int) -> None:
    """Scene graphs visited against the enumerated posterior.

    Their total variation, for 2, 3 and 4 objects. The kernel is the one that parses scenes; only the
    likelihood is replaced by a number for every graph: the same for all, and, in the column `with data`, at
    random.
    """
    from pipeline.benchmarks.sampler import document_of, measure_sampler

    with common.progress("sampler", "sizes") as progress:
        document = document_of(measure_sampler(common.seed, moves, progress))
    common.report(document, _lines(document))


def _lines(document: dict[str, Any]) -> list[str]:
    heads = ("objects", "graphs", "total variation", "independent draws", "with data", "seconds")
    lines = ["  ".join(heads)]
    for count, distance in document["total_variation"].items():
        cells = (
            count,
            document["trees"][count],
            f"{distance:.5f}",
            f"{document['independent_draws'][count]:.5f}",
            f"{document['with_data'][count]:.5f}",
            f"{document['seconds_by_objects'][count]:.1f}",
        )
        lines.append("  ".join(f"{cell:>{len(head)}}" for cell, head in zip(cells, heads, strict=True)))
    worst = max(document["involution_error"].values())
    lines.append(f"h(h(z)) = z to {worst:.1e}; compiled in {sum(document['compile_s'].values()):.1f} s")
    return lines
