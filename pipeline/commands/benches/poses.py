"""`voxscene bench poses`: known objects in clutter, beside registration peers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pipeline.options import Common, common_options


@click.command(name="poses")
@click.option("--tables", type=click.IntRange(min=1), default=100, show_default=True)
@click.option("--objects", type=click.IntRange(min=1), default=5, show_default=True, help="On each table.")
@click.option(
    "--meshes", type=click.Path(path_type=Path), metavar="DIR", help="Instead of the built-in objects."
)
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of the meshes; metres unless BOP's.")
@common_options()
def command(common: Common, tables: int, objects: int, meshes: Path | None, units: Any) -> None:
    """ADD-S on synthetic tables, a third of the objects stacked; depth only, no masks, objects known.

    Objects of which less than a quarter is seen are not judged. Seconds are of a table, after compiling.
    """
    from pipeline.jax_setup import keep_compiled_kernels

    keep_compiled_kernels()
    from pipeline.benchmarks.poses import PoseBench
    from pipeline.meshes import load_meshes
    from pipeline.quiet_stdout import stdout_to_stderr
    from pipeline.synthesis.objects import built_in_names, built_in_object

    if meshes is None:
        known = {name: built_in_object(name) for name in built_in_names()}
    else:
        known = load_meshes(meshes, units)
    with common.progress("poses", "tables") as progress, stdout_to_stderr():
        document = PoseBench(known, objects, common.seed).measure(
            tables, progress, lambda line: click.echo(line, err=True)
        )
    common.report(document, _lines(document))


def _lines(document: dict[str, Any]) -> list[str]:
    width = max(map(len, document["methods"]))
    lines = []
    for row in ("all", "on the table", "stacked"):
        lines.append(f"{row:<{width}}  objects  <5 mm  <10 mm  <20 mm    AUC  median mm")
        for name, figures in document["methods"].items():
            if row not in figures["rows"]:
                continue
            one = figures["rows"][row]
            shares = "  ".join(f"{share:>6.1%}" for share in one["accuracy"].values())
            lines.append(
                f"{name:<{width}}  {one['objects']:>7}  {shares}  {one['auc_0_10cm']:>5.1%}"
                f"  {1000 * one['median_m']:>9.1f}"
            )
    for name, figures in document["methods"].items():
        right = figures["parents_right_flush"]
        edges = "" if right is None else f", {right:.1%} of {figures['flush_rests']} flush rests right"
        timing = f"{figures['seconds_median']:.2f} s a table (most {figures['seconds_most']:.2f})"
        lines.append(f"{name:<{width}}  {timing}{edges}")
    return lines
