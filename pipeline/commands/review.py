"""`voxscene review`: look at a run in Rerun, or take a picture of it without a screen."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.errors import PipelineError
from pipeline.options import image_size


@click.command(name="review")
@click.argument("run", type=click.Path(path_type=Path))
@click.option(
    "--screenshot", type=click.Path(path_type=Path), metavar="OUT.png", help="Write a picture and end."
)
@click.option(
    "--size", default="1600x1000", show_default=True, metavar="WIDTHxHEIGHT", help="Of the picture."
)
@click.option("--frame", type=click.IntRange(0), help="Frame that the picture shows; the last unless given.")
@click.option("--rebuild", is_flag=True, help="Make run.rrd again from the run's values.")
def command(run: Path, screenshot: Path | None, size: str, frame: int | None, rebuild: bool) -> None:
    """Open RUN in Rerun with its views arranged.

    Of a project's run folder, every recording's run is opened.
    """
    from pipeline.views.screenshot import take_screenshot
    from pipeline.views.viewer import open_viewer, rrds_of

    width, height = image_size(size)
    rrds = rrds_of(run, rebuild=rebuild)
    if not rrds:
        raise PipelineError(f"{run} holds no run; make one with voxscene slam, learn, parse or demo")
    if screenshot:
        take_screenshot(rrds, screenshot, (width, height), frame)
        click.echo(f"{screenshot}: {width}x{height}")
    else:
        open_viewer(rrds)
