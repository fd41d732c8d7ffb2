"""`voxscene synth challenging`: images in which objects are hard to find, in two formats."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pipeline.errors import ConfigError
from pipeline.executors import Workers, executors_for
from pipeline.options import AnyPath, Common, common_options, image_size, words
from pipeline.progress import tell
from pipeline.synthesis.challenging_kinds import KINDS


@click.command(name="challenging")
@click.argument("out", type=AnyPath(file_okay=False))
@click.option("--images", type=click.IntRange(min=1), default=500, show_default=True, help="Of each kind.")
@click.option("--kinds", default=",".join(KINDS), show_default=True, metavar="KIND,...")
@click.option("--meshes", type=AnyPath(), metavar="DIR", help="Instead of the built-in objects.")
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of the meshes; metres unless BOP's.")
@click.option("--only", metavar="NAME,...", help="These objects alone.")
@click.option(
    "--visible", metavar="LOW:HIGH", help="Share of the target that is seen, within its kind's limits."
)
@click.option("--clutter", type=click.IntRange(0), help="Unknown things on the table.")
@click.option("--size", metavar="WIDTHxHEIGHT", help="Image size.")
@click.option("--noise-free", is_flag=True, default=None, help="Measure exactly.")
@click.option("--workers", type=Workers(), default=1, show_default=True, help="Processes, or a Dask cluster.")
@click.option("--force", is_flag=True, help="Replace images that were made with other settings.")
@common_options("synth", computes=True)
def command(
    common: Common,
    out: Path,
    images: int,
    kinds: str,
    meshes: Path | None,
    units: Any,
    only: str | None,
    visible: str | None,
    clutter: int | None,
    size: str | None,
    noise_free: bool | None,
    workers: int | str,
    force: bool,
) -> None:
    """Images in which objects are hard to find.

    \b
    single    one object, all in view
    stacked   two or three, one on another
    partial   the image's border leaves 0.2 to 0.7 of the object
    occluded  another object leaves 0.1 to 0.6 of it

    The folder OUT becomes a BOP data set (models, test, targets; depth in 0.1 mm), with recordings of one
    frame beside it that hold the truth. An interrupted run goes on with the same command; --images may grow.
    """  # noqa: D301  (click reads the \b)
    from pipeline.mesh_source import MeshSource
    from pipeline.synthesis.challenging_scene import ChallengingScene
    from pipeline.synthesis.challenging_set import ChallengingSet, write_set

    width, height = image_size(size) if size else (None, None)
    own = {
        "camera.width": width,
        "camera.height": height,
        "clutter": clutter,
        "sensor.noise_free": noise_free,
    }
    own["visible"] = _share_range(visible) if visible else None
    wanted = ChallengingSet(
        kinds=tuple(words("--kinds", kinds, list(KINDS))),
        images=images,
        scene=common.settings.section("synth", ChallengingScene, own),
        shapes=MeshSource.of(meshes, units, only),
        seed=common.seed,
    )
    executors, at_once = executors_for(workers)
    with common.progress(out.name, "images") as progress:
        remarks = write_set(wanted, out.resolve(), executors, at_once, progress, force=force)
    for remark in remarks:
        tell(f"voxscene: {remark}", err=True)
    count = images * len(wanted.kinds)
    document = {"path": str(out), "images": count, "kinds": list(wanted.kinds), "left_out": remarks}
    common.report(document, [f"{out}: {count} images of {len(wanted.shapes.meshes)} objects"])


def _share_range(text: str) -> tuple[float, float]:
    """Two shares from "0.1:0.4"."""
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError as error:
        raise ConfigError(f"--visible {text}: write LOW:HIGH, such as 0.1:0.4") from error
    return low, high
