"""`voxscene synth scenes`: films of a table of objects, to be parsed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pipeline.commands.syntheses.filming import scene_options, scene_settings, write_films
from pipeline.options import Common


@click.command(name="scenes")
@click.option("--objects", "count", type=click.IntRange(1), help="Objects on the table.")
@click.option("--only", metavar="NAME,...", help="Draw from these objects alone.")
@click.option(
    "--stacked",
    type=click.FloatRange(0, 1, max_open=True),
    metavar="SHARE",
    help="Least share of objects that rest on another.",
)
@click.option("--clutter", type=click.IntRange(0), help="Unknown things on the table.")
@scene_options
def command(
    common: Common,
    out: tuple[Path, ...],
    meshes: Path | None,
    units: Any,
    count: int | None,
    only: str | None,
    stacked: float | None,
    clutter: int | None,
    **options: Any,
) -> None:
    """Film a table of objects in each OUT, to be parsed."""
    from pipeline.mesh_source import MeshSource
    from pipeline.synthesis.filming import film_table
    from pipeline.synthesis.scenarios import TableScene

    own = {"objects": count, "stacked_share": stacked, "clutter": clutter}
    scene = common.settings.section("synth", TableScene, {**own, **scene_settings(**options)})
    shapes = MeshSource.of(meshes, units, only).meshes
    write_films(common, out, lambda index, _: film_table(shapes, scene, common.seed + index))
