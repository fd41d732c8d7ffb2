"""`voxscene bench poses`: known objects in synthetic images or a data set, beside other methods."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import click

from pipeline.commands.benches import pose_runs
from pipeline.commands.benches.pose_runs import PoseFiles
from pipeline.executors import Workers
from pipeline.options import (
    COMMON,
    AnyPath,
    Common,
    OutputFile,
    common_options,
    goes_on,
    image_size,
    words,
    written_flags,
)
from pipeline.peers import REGISTRATIONS
from pipeline.synthesis.challenging_kinds import KINDS

SOURCES = ("points", "masks", "both")
TABLES = 100
"""Unless another source is asked for."""

OF_SOURCES = {
    "kinds": "challenging",
    "noise": "challenging",
    "size": "challenging",
    "unasked": "worlds",
    "split": "data",
}
"""Options that say something of one source of images, and that source."""
NOT_OF_SOURCES = {
    "challenging": ("first", "objects"),
    "worlds": ("objects",),
    "data": ("first", "objects"),
}
"""Options that say nothing of a source of images."""
TABLE_NUMBERS, SHAPES = ("tables", "first"), ("meshes", "units", "only")
INSTEAD = {
    "growth": SHAPES,
    "absent": (*TABLE_NUMBERS, *SHAPES, "objects"),
    "lookalikes": TABLE_NUMBERS,
    "copies": (*TABLE_NUMBERS, *SHAPES),
    "decoys": (*TABLE_NUMBERS, *SHAPES),
    "calibration": (*TABLE_NUMBERS, *SHAPES, "csv_path"),
}
"""Measurements that make images of their own, in one column, and the options that say something of them."""
OF_COLUMNS = ("share_search", "learned", "against", "results")
"""Options that say nothing of --proposals."""


class NamedFile(click.ParamType):
    """`NAME=FILE`."""

    name = "NAME=FILE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Name and path."""
        if isinstance(value, tuple):
            return value
        name, separator, path = str(value).partition("=")
        if not separator or not name or not path:
            return self.fail(f"{value!r} is not NAME=FILE", param, ctx)
        return name, Path(path).resolve()


@click.command(name="poses")
@click.option(
    "--tables", type=click.IntRange(min=1), metavar="N", help=f"Synthetic tables; {TABLES} by default."
)
@click.option(
    "--first", type=click.IntRange(min=0), default=0, show_default=True, help="Number of the first table."
)
@click.option("--objects", type=click.IntRange(min=1), default=5, show_default=True, help="On each table.")
@click.option(
    "--challenging", type=click.IntRange(min=1), metavar="N", help="N images of each kind instead of tables."
)
@click.option(
    "--kinds", default=",".join(KINDS), show_default=True, metavar="KIND,...", help="Of these images."
)
@click.option(
    "--noise",
    type=click.FloatRange(min=0.1),
    default=1.0,
    show_default=True,
    help="Of these images, times the usual.",
)
@click.option("--size", metavar="WIDTHxHEIGHT", default="640x480", show_default=True, help="Of these images.")
@click.option(
    "--share-search",
    is_flag=True,
    help="The second column, with fixed graphs, gets the first one's search, which lets things rest.",
)
@click.option(
    "--worlds", type=click.IntRange(min=1), metavar="N", help="N worlds like real ones instead of tables."
)
@click.option(
    "--unasked",
    type=AnyPath(),
    metavar="DIR",
    help="Meshes of things in these worlds that are not requested.",
)
@click.option("--data", type=AnyPath(), metavar="DIR", help="A BOP data set, or YCB-Video frames.")
@click.option("--split", default="test", show_default=True, help="Folder of the data set's scenes.")
@click.option("--meshes", type=AnyPath(), metavar="DIR", help="Instead of built-in or the data's.")
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of the meshes; metres unless BOP's.")
@click.option("--only", metavar="NAME,...", help="These objects alone.")
@click.option(
    "--learned",
    type=click.IntRange(min=1),
    metavar="VIEWS",
    help="Look for shapes learned by slam and learn from so many views, in place of the meshes.",
)
@click.option(
    "--against",
    metavar="PEER,...",
    default="fpfh,icp24",
    show_default=True,
    help=f"Peers of {', '.join(REGISTRATIONS)} to run on the same images; an empty word for none.",
)
@click.option(
    "--results", multiple=True, type=NamedFile(), help="Another program's BOP results file as a column."
)
@click.option(
    "--growth", is_flag=True, help="Instead: seconds of a table against its number of objects, 1 to 10."
)
@click.option(
    "--absent",
    type=click.IntRange(min=1),
    metavar="K",
    help="Instead: request so many shapes that are not there in place of so many that are.",
)
@click.option(
    "--lookalikes",
    is_flag=True,
    help="Instead: of two shapes that depth hardly tells apart both are requested and one is there; by depth"
    " alone and with --colour add.",
)
@click.option(
    "--copies",
    is_flag=True,
    help="Instead: two or three things of one shape stand on a table, one more is requested.",
)
@click.option(
    "--decoys",
    is_flag=True,
    help="Instead: a thing that is not requested stands there, into which what is requested may be laid: a"
    " larger box, a block, a carrier; what is reported, and log evidence of the truth less that of the"
    " likeliest such place.",
)
@click.option(
    "--calibration",
    is_flag=True,
    help="Instead: tables drawn from the model itself, image included; are presences and poses calibrated?",
)
@click.option(
    "--proposals",
    metavar="SOURCE,...",
    help=f"Instead: sources of the search's poses ({', '.join(SOURCES)}): the best hypothesis of each"
    " object, and what is found; the first source less each other.",
)
@click.option(
    "--keep",
    type=AnyPath(),
    metavar="DIR",
    help="Keep rows; what is there is not run again.",
)
@click.option("--csv", "csv_path", type=OutputFile(), help="Write all rows as one table.")
@click.option(
    "--bop",
    type=OutputFile(),
    metavar="FILE.csv",
    help="Write what our column found as a BOP results file.",
)
@click.option(
    "--curves",
    type=OutputFile(".png", ".svg"),
    metavar="FILE.png|svg",
    help="Draw accuracy curves.",
)
@click.option(
    "--sheets", type=AnyPath(file_okay=False), metavar="DIR", help="Draw the images of largest difference."
)
@click.option("--watch", is_flag=True, help="Print the tables so far of --keep, and judge nothing.")
@click.option("--workers", type=Workers(), default=1, show_default=True, help="Processes, or a Dask cluster.")
@common_options(computes=True)
def command(
    common: Common,
    tables: int | None,
    first: int,
    objects: int,
    challenging: int | None,
    kinds: str,
    noise: float,
    size: str,
    share_search: bool,
    worlds: int | None,
    unasked: Path | None,
    data: Path | None,
    split: str,
    meshes: Path | None,
    units: Any,
    only: str | None,
    learned: int | None,
    against: str,
    results: tuple[tuple[str, Path], ...],
    growth: bool,
    absent: int | None,
    lookalikes: bool,
    copies: bool,
    decoys: bool,
    calibration: bool,
    proposals: str | None,
    keep: Path | None,
    csv_path: Path | None,
    bop: Path | None,
    curves: Path | None,
    sheets: Path | None,
    watch: bool,
    workers: int | str,
) -> None:
    """ADD-S of known objects, against other methods.

    In synthetic tables, in images in which objects are hard to find (--challenging), in worlds like real ones
    (--worlds), or in a data set (--data); against registration, ICP and other programs. Depth only, no masks,
    objects known; all of them are judged, however little is seen of them. Seconds are of an image, without
    compiling. With --keep an interrupted run goes on where it stopped.
    """
    from pipeline.benchmarks.pose_figures import pose_figures
    from pipeline.benchmarks.pose_methods import OURS, SEARCH_SHARED
    from pipeline.benchmarks.pose_report import report_lines
    from pipeline.mesh_source import MeshSource

    _refuse_unused()
    if sum(one is not None for one in (tables, challenging, worlds, data)) > 1:
        raise click.UsageError("--tables, --challenging, --worlds and --data are four sources; name one")
    if watch and keep is None:
        raise click.UsageError("--watch needs --keep, where the rows are")
    if keep:
        goes_on()
    if data is not None and meshes is None:
        from pipeline.benchmarks.bop_targets import models_folder

        meshes, units = models_folder(data), units or "mm"
    shapes = MeshSource.of(meshes, units, only)
    numbers = tuple(range(first, first + (tables or worlds or TABLES)))
    if growth:
        pose_runs.measure_growth(common, shapes)
        return
    if absent:
        pose_runs.measure_presences(common, shapes, objects, numbers, absent)
        return
    if lookalikes:
        pose_runs.compare_lookalikes(common, numbers)
        return
    if copies:
        pose_runs.count_copies(common, shapes, numbers)
        return
    if decoys:
        pose_runs.judge_decoys(common, shapes, numbers)
        return
    if calibration:
        pose_runs.judge_drawn_tables(common, shapes, numbers, csv_path)
        return
    if worlds is not None:
        others = MeshSource.of(unasked, units) if unasked else None
        source = pose_runs.world_source(common, shapes, others, numbers)
    else:
        seen = noise, image_size(size)
        source = pose_runs.pose_source(
            common, shapes, objects, numbers, challenging, kinds, seen, data, split
        )
    files = PoseFiles(keep=keep, csv=csv_path, bop=bop, curves=curves, sheets=sheets)
    if proposals:
        chosen = words("--proposals", proposals, SOURCES)
        pose_runs.compare_proposals(common, source, chosen, workers, files, watch=watch)
        return
    peers = pose_runs.other_methods(shapes, source, words("--against", against, REGISTRATIONS), results)
    methods = [
        *(one.of(common.seed, learned or 0) for one in (SEARCH_SHARED if share_search else OURS)),
        *peers,
    ]
    pose_runs.judge(common, source, methods, workers, files, (pose_figures, report_lines), watch=watch)


def _refuse_unused() -> None:
    """Refuse options that were written and would say nothing.

    Raises:
        UsageError: one was.
    """
    written = written_flags()
    for name, source in OF_SOURCES.items():
        if name in written and source not in written:
            raise click.UsageError(f"{written[name]} needs --{source}, whose images it is about")
    for measurement, used in INSTEAD.items():
        if measurement in written:
            _refuse(written, set(written) - {measurement, *used, *COMMON}, measurement, "images")
    for source, unused in NOT_OF_SOURCES.items():
        if source in written:
            _refuse(written, unused, source, "images")
    if "proposals" in written:
        _refuse(written, OF_COLUMNS, "proposals", "columns")


def _refuse(written: Mapping[str, str], unused: Collection[str], chosen: str, what: str) -> None:
    for name, flag in written.items():
        if name in unused:
            raise click.UsageError(f"--{chosen} makes {what} of its own, about which {flag} says nothing")
