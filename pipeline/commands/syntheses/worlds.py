"""`voxscene synth worlds`: single frames of worlds like the real ones in which parsing fails."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pipeline.errors import PipelineError
from pipeline.options import AnyPath, Common, common_options


@click.command(name="worlds")
@click.argument("out", nargs=-1, required=True, type=AnyPath(dir_okay=False))
@click.option("--meshes", type=AnyPath(), metavar="DIR", help="Instead of the built-in objects.")
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of the meshes; metres unless BOP's.")
@click.option("--only", metavar="NAME,...", help="These objects alone.")
@click.option(
    "--unasked",
    type=AnyPath(),
    metavar="DIR",
    help="Meshes of things that are not requested.",
)
@click.option("--objects", type=click.IntRange(1), help="That are there and requested.")
@click.option("--absent", type=click.IntRange(0), help="Requested shapes that are not there.")
@click.option("--clutter", type=click.IntRange(0), help="Things of no mesh at all.")
@common_options("synth", computes=True)
def command(
    common: Common,
    out: tuple[Path, ...],
    meshes: Path | None,
    units: Any,
    only: str | None,
    unasked: Path | None,
    objects: int | None,
    absent: int | None,
    clutter: int | None,
) -> None:
    """Film a world like the real ones in each OUT.

    One frame, with the truth in the file: a small table over a floor, seats and a shelf near by, things that
    are not requested, requested shapes that are not there; a sensor with errors that are correlated over
    pixels, holes on dark and shining faces, steps that grow with the distance and a wrong scale. What is to
    be requested is printed.
    """
    from pipeline.mesh_source import MeshSource
    from pipeline.synthesis.worlds import WorldScene, film_world
    from pipeline.synthesis.writing import write_recording

    own = {"objects": objects, "absent": absent, "clutter": clutter}
    scene = common.settings.section("synth", WorldScene, own)
    shapes = MeshSource.of(meshes, units, only).meshes
    if (wanted := (objects or 0) + (absent or 0)) > len(shapes):
        raise PipelineError(f"--objects and --absent name {wanted} shapes; there are {len(shapes)} meshes")
    others = MeshSource.of(unasked, units).meshes if unasked else {}
    document = []
    with common.progress("worlds", "films") as progress:
        for index, path in enumerate(out):
            world = film_world(shapes, others, scene, common.seed + index)
            write_recording(world.recording, path)
            there = [one.shape for one in world.recording.truth.objects]
            document.append({"path": str(path), "there": there, "absent": list(world.absent)})
            progress(index + 1, len(out))
    common.report(
        document,
        [f"{one['path']}: --objects {','.join(sorted([*one['there'], *one['absent']]))}" for one in document],
    )
