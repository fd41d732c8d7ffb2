"""`voxscene export`: learned shapes and runs in the formats that other programs take."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import click

from pipeline.errors import ConfigError
from pipeline.options import Common, common_options


@click.command(name="export")
@click.argument("source", metavar="SHAPE.npz|RUN", type=click.Path(path_type=Path))
@click.option(
    "--format",
    "formats",
    required=True,
    metavar="FORMAT,...",
    help="Of a shape: npz, ply, obj, glb, stl, bop. Of a RUN (the fused room and its objects): ply, glb.",
)
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, metavar="DIR")
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of a shape's mesh files; m.")
@click.option("--shells", is_flag=True, help="Also the surfaces where the probability is 0.1 and 0.9.")
@common_options()
def command(
    common: Common,
    source: Path,
    formats: str,
    output: Path,
    units: Any,
    shells: bool,
) -> None:
    """Write a learned shape, or what a RUN found, for other programs.

    A manifest.json beside it says what is what. Surfaces are closed and wound outward, with enclosed voxels
    filled. Meshes are in metres unless --units says otherwise; BOP is in millimetres and GLB in metres by
    their own rules.
    """
    from pipeline.export.run_export import RUN_FORMATS, export_run
    from pipeline.export.shape_export import SHAPE_FORMATS, export_shape

    is_run = source.is_dir()
    known = RUN_FORMATS if is_run else SHAPE_FORMATS
    wanted = tuple(dict.fromkeys(part.strip() for part in formats.split(",")))
    for form in wanted:
        if form not in known:
            kind = "a run" if is_run else "a shape"
            raise ConfigError(f"--format {form}: {kind} is written as {', '.join(known)}")
    if is_run:
        paths = export_run(source, wanted, output)
    else:
        paths = export_shape(source, wanted, output, units=cast(Any, units or "m"), shells=shells)
    common.report({"files": [str(path) for path in paths]}, [str(path) for path in paths])
