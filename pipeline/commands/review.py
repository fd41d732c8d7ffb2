"""`voxscene review`: look at a run in Rerun, or take a picture of it without a screen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from shlex import quote

import click

from pipeline.errors import PipelineError
from pipeline.options import AnyPath, Common, OutputFile, common_options, image_size, only_for
from pipeline.progress import Progress


@click.command(name="review")
@click.argument("run", type=AnyPath())
@click.option("--screenshot", type=OutputFile(".png"), metavar="OUT.png", help="Write a picture and end.")
@click.option(
    "--size", default="1600x1000", show_default=True, metavar="WIDTHxHEIGHT", help="Of the picture."
)
@click.option("--frame", type=click.IntRange(0), help="Frame that the picture shows; the last unless given.")
@click.option(
    "--web", is_flag=True, help="Serve it to a browser, on 127.0.0.1 alone, for machines without a screen."
)
@click.option(
    "--port",
    type=click.IntRange(1, 65534),
    default=9090,
    show_default=True,
    help="Of the page of --web; the next one is for its data.",
)
@click.option(
    "--from-mcap",
    is_flag=True,
    help="RUN is a run.mcap on its own; its values are in it, and run.rrd is made next to it.",
)
@click.option(
    "--truth",
    type=AnyPath(),
    metavar="TUM|REC",
    help="Also show the truth of a recording or a TUM file, and how much of it the reported regions hold.",
)
@click.option("--rebuild", is_flag=True, help="Make run.rrd again from the run's values.")
@common_options()
def command(
    common: Common,
    run: Path,
    screenshot: Path | None,
    size: str,
    frame: int | None,
    web: bool,
    port: int,
    from_mcap: bool,
    truth: Path | None,
    rebuild: bool,
) -> None:
    """Open RUN in Rerun with its views arranged.

    Of a project's run folder, every recording's run is opened; a picture shows the last of them.
    """
    from pipeline.run_folder import RunFolder, holds_stages
    from pipeline.views.screenshot import take_screenshot
    from pipeline.views.viewer import open_viewer, rrd_of_mcap, rrd_with_truth, rrds_of, serve_viewer

    if not screenshot:
        only_for("--screenshot", "size", "frame")
    if not web:
        only_for("--web", "port")
    if screenshot:
        only_for("a review without --screenshot", "web")
    if from_mcap:
        only_for("a run folder", "truth", "rebuild")
    if truth:
        only_for("a review without --truth, which makes its views each time", "rebuild")
    width, height = image_size(size)
    if from_mcap:
        rrds = [rrd_of_mcap(run)]
    else:
        rrds = [rrd_with_truth(run, truth)] if truth else rrds_of(run, rebuild=rebuild)
    if not rrds:
        if any(RunFolder(one).changed for one in [run, *run.glob("recordings/*")]):
            raise PipelineError(
                f"{run} is of another version, or was changed by hand; the command that made it makes it anew"
            )
        if holds_stages(run):
            raise PipelineError(f"{run} holds no finished stage; the command that began it goes on with it")
        raise PipelineError(f"{run} holds no run; make one with voxscene slam, learn, parse or demo")
    if screenshot:
        take_screenshot(rrds, screenshot, (width, height), frame)
        shows = str(run if from_mcap else rrds[-1].parent)
        document = {"screenshot": str(screenshot), "width": width, "height": height, "shows": shows}
        common.report(document, [f"{screenshot}: {width}x{height}, shows {shows}", *_others(rrds)])
        return
    with Progress("review", "", quiet=True):  # from now on the viewer shows that it lives
        if web:
            serve_viewer(rrds, port, lambda address: common.report({"address": address}, [address]))
        else:
            open_viewer(rrds)
            shown = [str(rrd) for rrd in rrds]
            common.report({"shown": shown}, [f"shown: {', '.join(shown)}"])


def _others(rrds: Sequence[Path]) -> list[str]:
    """How to take a picture of the runs beside the one that is shown, where there are some."""
    if len(rrds) < 2:
        return []
    names = ", ".join(rrd.parent.name for rrd in rrds[:-1])
    one = quote(str(rrds[0].parent))
    return [f"others here: {names}; of one of them: voxscene review {one} --screenshot OUT.png"]
