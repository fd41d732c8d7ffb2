"""`voxscene bench poses`: known objects in synthetic images or a data set, beside other methods."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import click

from pipeline.errors import PipelineError
from pipeline.executors import Workers, executors_for
from pipeline.options import Common, common_options, words

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.benchmarks.pose_methods import Method
    from pipeline.benchmarks.pose_sources import PoseSource

PEERS = ("fpfh", "icp24", "ppf")
KINDS = ("single", "stacked", "partial", "occluded")
SOURCES = ("points", "masks", "both")
MOST_OBJECTS = 10
ESTIMATE_AFTER = 8
"""Images after which the remaining time is told."""
TABLES = 100
"""Unless another source is asked for."""


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
    "--worlds", type=click.IntRange(min=1), metavar="N", help="N worlds like real ones instead of tables."
)
@click.option(
    "--unasked",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Meshes of things in these worlds that nobody asks for.",
)
@click.option(
    "--data", type=click.Path(path_type=Path), metavar="DIR", help="A BOP data set, or YCB-Video frames."
)
@click.option("--split", default="test", show_default=True, help="Folder of the data set's scenes.")
@click.option(
    "--meshes", type=click.Path(path_type=Path), metavar="DIR", help="Instead of built-in or the data's."
)
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
    help=f"Peers of {', '.join(PEERS)} to run on the same images; an empty word for none.",
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
    help="Instead: ask for so many shapes that are not there in place of so many that are.",
)
@click.option(
    "--lookalikes",
    is_flag=True,
    help="Instead: of two shapes that depth hardly tells apart both are asked for and one is there; by depth"
    " alone and with --colour add.",
)
@click.option(
    "--proposals",
    metavar="SOURCE,...",
    help=f"Instead: where the search's poses come from ({', '.join(SOURCES)}): the best hypothesis of each"
    " object, and what is found; the first source less each other.",
)
@click.option(
    "--keep",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Keep rows; what is there is not run again.",
)
@click.option(
    "--csv", "csv_path", type=click.Path(path_type=Path, dir_okay=False), help="Write all rows as one table."
)
@click.option(
    "--bop",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.csv",
    help="Write what our column found as a BOP results file.",
)
@click.option(
    "--curves",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.png|svg",
    help="Draw accuracy curves.",
)
@click.option(
    "--sheets", type=click.Path(path_type=Path), metavar="DIR", help="Draw the images of largest difference."
)
@click.option("--watch", is_flag=True, help="Print the tables so far of --keep, and judge nothing.")
@click.option("--workers", type=Workers(), default=1, show_default=True, help="Processes, or a Dask cluster.")
@common_options()
def command(
    common: Common,
    tables: int | None,
    first: int,
    objects: int,
    challenging: int | None,
    kinds: str,
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
    proposals: str | None,
    keep: Path | None,
    csv_path: Path | None,
    bop: Path | None,
    curves: Path | None,
    sheets: Path | None,
    watch: bool,
    workers: int | str,
) -> None:
    """ADD-S of known objects, beside other methods.

    In synthetic tables, in images in which objects are hard to find (--challenging), in worlds like real ones
    (--worlds), or in a data set (--data); beside registration, ICP and other programs. Depth only, no masks,
    objects known; all of them are judged, however little is seen of them. Seconds are of an image, without
    compiling. With --keep an interrupted run goes on where it stopped.
    """
    from pipeline.jax_setup import keep_compiled_kernels

    keep_compiled_kernels()
    from pipeline.benchmarks.pose_figures import pose_figures
    from pipeline.benchmarks.pose_methods import OURS
    from pipeline.benchmarks.pose_report import report_lines
    from pipeline.mesh_source import MeshSource

    if sum(one is not None for one in (tables, challenging, worlds, data)) > 1:
        raise click.UsageError("--tables, --challenging, --worlds and --data are four sources; name one")
    if watch and keep is None:
        raise click.UsageError("--watch needs --keep, where the rows are")
    if data is not None and meshes is None:
        from pipeline.benchmarks.bop_targets import models_folder

        meshes, units = models_folder(data), units or "mm"
    shapes = MeshSource.of(meshes, units, only)
    numbers = tuple(range(first, first + (tables or TABLES)))
    if growth:
        _growth(common, shapes)
    elif absent:
        _presences(common, shapes, objects, numbers, absent)
    elif lookalikes:
        _lookalikes(common, numbers)
    else:
        if worlds is not None:
            from pipeline.benchmarks.pose_sources import Worlds
            from pipeline.synthesis.worlds import WorldScene

            source = Worlds(
                shapes=shapes,
                others=MeshSource.of(unasked, units) if unasked else None,
                scene=WorldScene(),
                seed=common.seed,
                numbers=tuple(range(first, first + worlds)),
            )
        else:
            source = _source(common, shapes, objects, numbers, challenging, kinds, data, split)
        files = keep, csv_path, bop, curves, sheets
        if proposals:
            _proposals(common, source, words("--proposals", proposals, SOURCES), workers, files, watch=watch)
            return
        ours = [one.of(common.seed, learned or 0) for one in OURS]
        methods = [*ours, *_others(shapes, source, words("--against", against, PEERS), results)]
        _judge(common, source, methods, workers, files, (pose_figures, report_lines), watch=watch)


def _source(
    common: Common,
    shapes: Any,
    objects: int,
    numbers: tuple[int, ...],
    challenging: int | None,
    kinds: str,
    data: Path | None,
    split: str,
) -> PoseSource:
    from pipeline.benchmarks.pose_sources import BopImages, Tables, challenging_images
    from pipeline.synthesis.challenging_scene import ChallengingScene

    if data is not None:
        return BopImages(root=data.resolve(), split=split, shapes=shapes)
    if challenging is not None:
        chosen = tuple(words("--kinds", kinds, KINDS))
        return challenging_images(shapes, chosen, challenging, ChallengingScene(), common.seed)
    return Tables(shapes=shapes, objects=objects, seed=common.seed, numbers=numbers)


def _others(
    shapes: Any, source: PoseSource, peers: Sequence[str], results: Sequence[tuple[str, Path]]
) -> list[Method]:
    """Peers with the settings that suit them best, and results files, which are looked through first."""
    from pipeline.benchmarks.bop_results import check_results
    from pipeline.benchmarks.pose_methods import Results, registrations
    from pipeline.benchmarks.poses import tuned
    from pipeline.peers.registration import settings
    from pipeline.quiet_stdout import stdout_to_stderr

    images = {(key.scene_id, key.im_id) for key in source.places()}
    for _, path in results:
        check_results(path, shapes.ids.values(), images)
    if "ppf" in peers:
        try:
            import cv2  # noqa: F401  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise PipelineError("ppf needs OpenCV's contributions: pip install 'voxscene[bench]'") from error
    with stdout_to_stderr():
        chosen = [
            tuned(method, shapes, list(settings()[peer])) for peer in peers for method in registrations(peer)
        ]
    return [*chosen, *(Results(title=name, path=path) for name, path in results)]


def _judge(
    common: Common,
    source: PoseSource,
    methods: Sequence[Method],
    workers: int | str,
    files: tuple[Path | None, ...],
    report: tuple[Callable[..., dict[str, Any]], Callable[[dict[str, Any]], list[str]]],
    *,
    watch: bool,
) -> None:
    """Images judged, and what `report` makes of the rows and seconds: figures, and lines of these."""
    from pipeline.benchmarks.bop_results import write_results
    from pipeline.benchmarks.pose_report import image_line
    from pipeline.benchmarks.pose_rows import write_csv
    from pipeline.benchmarks.poses import RemainingTime, collected, judged_images, kept_images

    keep, csv_path, bop, curves, sheets = files
    figures, lines = report
    executors, at_once = executors_for(workers)
    done = list(kept_images(source, methods, keep)) if watch else []
    try:
        with common.progress("poses", "images") as progress:
            remaining = RemainingTime(ESTIMATE_AFTER, lambda line: _say(common, line), progress)
            if not watch:
                for key, found in judged_images(source, methods, executors, at_once, keep, remaining):
                    done.append((key, found))
                    _say(common, image_line(found))
    finally:
        judged, seconds = collected(done)
        document = figures(judged, seconds)
        common.report(document, lines(document))
        if csv_path and judged:
            write_csv(csv_path, judged)
        if bop and judged:
            title = methods[0].title
            rows = [one for one in judged if one.method == title]
            write_results(bop, rows, source.shapes.ids, seconds[title])
    if curves:
        from pipeline.figures.accuracy_curves import draw_curves

        draw_curves(judged, curves)
    if sheets:
        from pipeline.figures.pose_sheets import draw_sheets

        for path in draw_sheets(judged, source, sheets):
            _say(common, str(path))


def _proposals(
    common: Common,
    source: PoseSource,
    sources: Sequence[str],
    workers: int | str,
    files: tuple[Path | None, ...],
    *,
    watch: bool,
) -> None:
    from functools import partial

    from pipeline.benchmarks.pose_proposals import (
        Source,
        proposal_figures,
        proposal_lines,
        proposal_methods,
    )

    methods = proposal_methods(cast("Sequence[Source]", sources), common.seed)
    report = partial(proposal_figures, sources=sources), proposal_lines
    _judge(common, source, methods, workers, files, report, watch=watch)


def _growth(common: Common, shapes: Any) -> None:
    from pipeline.benchmarks.pose_growth import growth
    from pipeline.benchmarks.pose_methods import OURS
    from pipeline.quiet_stdout import stdout_to_stderr

    rows: list[dict[str, Any]] = []
    remaining = growth(shapes, OURS[0].of(common.seed, 0), MOST_OBJECTS)
    _say(common, "objects  seconds  compiled before  under 1 cm")
    while len(rows) < MOST_OBJECTS:
        with stdout_to_stderr():
            rows.append(next(remaining))
        row = rows[-1]
        cells = (f"{row['objects']:>7}", f"{row['seconds']:>7.2f}", f"{row['compile_s']:>13.1f} s")
        share = "" if row["under_1cm"] is None else f"{row['under_1cm']:.1%}"
        _say(common, "  ".join((*cells, f"{share:>10}")))
    each = rows[-1]["seconds"] / MOST_OBJECTS
    common.report(
        {"growth": rows}, [f"{each:.2f} s an object of {MOST_OBJECTS}, {rows[0]['seconds']:.2f} s of one"]
    )


def _presences(common: Common, shapes: Any, objects: int, numbers: Sequence[int], absent: int) -> None:
    from pipeline.benchmarks.pose_presence import presences
    from pipeline.benchmarks.pose_report import presence_lines
    from pipeline.benchmarks.pose_sources import Tables
    from pipeline.benchmarks.presence_figures import presence_figures
    from pipeline.quiet_stdout import stdout_to_stderr

    tables = Tables(shapes=shapes, objects=objects, seed=common.seed, numbers=tuple(numbers))
    reported = []
    for number in numbers:
        with stdout_to_stderr():
            table = presences(tables, number, absent, common.seed)
        reported += table
        said = (f"{one.shape}{'' if one.there else ' (absent)'} {one.presence:.2f}" for one in table)
        _say(common, f"table {number}: {', '.join(said)}")
    figures = presence_figures(reported)
    common.report(figures, presence_lines(figures))


def _lookalikes(common: Common, numbers: Sequence[int]) -> None:
    from pipeline.benchmarks.lookalikes import judge_table, lookalike_figures, lookalike_lines
    from pipeline.quiet_stdout import stdout_to_stderr

    rows = []
    with common.progress("lookalikes", "tables") as progress:
        for done, number in enumerate(numbers, 1):
            with stdout_to_stderr():
                rows += judge_table(number, common.seed)
            progress(done, len(numbers))
    figures = lookalike_figures(rows)
    common.report(figures, lookalike_lines(figures))


def _say(common: Common, line: str) -> None:
    if not (common.as_json or common.quiet):
        click.echo(line)
