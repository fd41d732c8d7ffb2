"""`voxscene reproduce`: the supplement's tables, curves and pictures, or the same for one's own objects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pipeline.executors import Workers, executors_for
from pipeline.options import AnyPath, Common, common_options, words
from pipeline.peers import REGISTRATIONS
from pipeline.progress import tell

SECTIONS = ("C", "D", "E", "F", "G", "H", "L", "O")


@click.command(name="reproduce")
@click.option("-o", "--output", type=AnyPath(file_okay=False), required=True, metavar="DIR")
@click.option("--only", metavar="LETTER,...", help=f"Sections of the supplement: {', '.join(SECTIONS)}.")
@click.option("--images", type=click.IntRange(min=1), default=25, show_default=True, help="Of each kind.")
@click.option("--meshes", type=AnyPath(), metavar="DIR", help="Instead of the built-in objects.")
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of the meshes; metres unless BOP's.")
@click.option("--objects", metavar="NAME,...", help="These objects alone.")
@click.option("--data", type=AnyPath(), metavar="BOP_ROOT", help="Real images, for section F.")
@click.option("--split", default="test", show_default=True, help="Folder of the data set's scenes.")
@click.option(
    "--against", default="fpfh", show_default=True, metavar="PEER,...", help=f"Of {', '.join(REGISTRATIONS)}."
)
@click.option("--workers", type=Workers(), default=1, show_default=True, help="Processes, or a Dask cluster.")
@common_options(computes=True)
def command(
    common: Common,
    output: Path,
    only: str | None,
    images: int,
    meshes: Path | None,
    units: Any,
    objects: str | None,
    data: Path | None,
    split: str,
    against: str,
    workers: int | str,
) -> None:
    """The paper's experiments on one page.

    DIR/report.html, with tables and figures next to it.

    \b
    C  shapes from five views under the paper's conditions
    D  images in which objects are hard to find
    E  accuracy of poses in them, with curves; G, H: outlines on the images
    F  the same in a data set of real images (--data)
    L  the probability of a mug that no pixel shows
    O  the sampler of scene graphs against enumeration

    With --meshes the page says how well it works on your own objects. An interrupted run goes on with the
    same command.
    """  # noqa: D301  (click reads the \b)
    from pipeline.atomic import write_text
    from pipeline.benchmarks.bop_targets import models_folder
    from pipeline.benchmarks.pose_sources import BopImages
    from pipeline.mesh_source import MeshSource
    from pipeline.quiet_stdout import stdout_to_stderr
    from pipeline.reproduction.reproduce import reproduce
    from pipeline.reproduction.request import Request

    chosen = set(
        words("--only", only, SECTIONS) if only else set(SECTIONS) - ({"F"} if data is None else set())
    )
    if chosen & {"G", "H"} and not chosen & {"E", "F"}:
        chosen.add("E")  # the outlines are of its poses
    if data is not None and meshes is None:
        meshes, units = models_folder(data), units or "mm"
    shapes = MeshSource.of(meshes, units, objects)
    executors, at_once = executors_for(workers)

    def say(sentence: str) -> None:
        if not common.quiet:
            tell(sentence, err=True)

    for part in ("tables", "figures"):
        (output / part).mkdir(parents=True, exist_ok=True)
    with common.progress("reproduce", "images") as progress, stdout_to_stderr():
        request = Request(
            out=output.resolve(),
            shapes=shapes,
            images=images,
            data=None if data is None else BopImages(root=data.resolve(), split=split, shapes=shapes),
            peers=tuple(words("--against", against, REGISTRATIONS)),
            seed=common.seed,
            executors=executors,
            at_once=at_once,
            say=say,
            progress=progress,
        )
        page = reproduce(request, sorted(chosen))
    path = output / "report.html"
    write_text(path, page.html())
    megabytes = path.stat().st_size / 1e6
    common.report({"report": str(path), "megabytes": megabytes}, [f"wrote {path} ({megabytes:.1f} MB)"])
