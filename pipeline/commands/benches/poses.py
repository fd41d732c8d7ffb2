"""`voxscene bench poses`: known objects in clutter, beside registration peers."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline.options import Common, common_options, words

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipeline.benchmarks.pose_figures import Judged
    from pipeline.benchmarks.poses import PoseBench

PEERS = ("fpfh", "icp24")
MOST_OBJECTS = 10


@click.command(name="poses")
@click.option("--tables", type=click.IntRange(min=1), default=100, show_default=True)
@click.option(
    "--first", type=click.IntRange(min=0), default=0, show_default=True, help="Number of the first table."
)
@click.option("--objects", type=click.IntRange(min=1), default=5, show_default=True, help="On each table.")
@click.option(
    "--meshes", type=click.Path(path_type=Path), metavar="DIR", help="Instead of the built-in objects."
)
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of the meshes; metres unless BOP's.")
@click.option(
    "--learned",
    type=click.IntRange(min=1),
    metavar="VIEWS",
    help="Look for shapes learned by slam and learn from so many views, in place of the meshes.",
)
@click.option(
    "--against",
    metavar="PEER,...",
    default=",".join(PEERS),
    show_default=True,
    help="Peers to run on the same tables; an empty word for none.",
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
    "--csv",
    "csv_path",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Add the rows of each table as it is done; tables that the file holds already are not run again.",
)
@common_options()
def command(
    common: Common,
    tables: int,
    first: int,
    objects: int,
    meshes: Path | None,
    units: Any,
    learned: int | None,
    against: str,
    growth: bool,
    absent: int | None,
    csv_path: Path | None,
) -> None:
    """ADD-S on synthetic tables, beside registration and ICP.

    A third of the objects is stacked; depth only, no masks, objects known.

    Objects of which less than a quarter is seen are not judged. Seconds are of a table, without compiling.
    Each table's line is printed when it is done; an interrupted run prints the figures of those before.
    """
    from pipeline.jax_setup import keep_compiled_kernels

    keep_compiled_kernels()
    from pipeline.benchmarks.learned_objects import learned_object, true_object
    from pipeline.benchmarks.poses import PoseBench
    from pipeline.meshes import load_meshes
    from pipeline.synthesis.objects import built_in_names, built_in_object

    peers = words("--against", against, PEERS)
    if meshes is None:
        known = {name: built_in_object(name) for name in built_in_names()}
    else:
        known = load_meshes(meshes, units)
    sought = partial(learned_object, views=learned, seed=common.seed) if learned else true_object
    bench = PoseBench(known, objects, common.seed, sought)
    if growth:
        _growth(common, bench)
    elif absent:
        _presences(common, bench, range(first, first + tables), absent)
    else:
        _tables(common, bench, range(first, first + tables), peers, csv_path)


def _tables(
    common: Common, bench: PoseBench, numbers: range, peers: Sequence[str], csv_path: Path | None
) -> None:
    from pipeline.benchmarks.pose_figures import append_rows, pose_figures, read_rows

    judged = read_rows(csv_path) if csv_path else []
    done = {one.table for one in judged}
    try:
        for table in _judged_tables(bench, [one for one in numbers if one not in done], peers, judged):
            judged += table
            if csv_path:
                append_rows(csv_path, table)
            _say(common, _table_line(table))
    finally:
        document = pose_figures(judged)
        common.report(document, _lines(document))


def _judged_tables(bench: PoseBench, numbers: Sequence[int], peers: Sequence[str], before: Sequence[Judged]):
    """The rows of one table after another; peers keep the settings of the rows before."""
    from pipeline.benchmarks.poses import PEERS as TITLES
    from pipeline.quiet_stdout import stdout_to_stderr

    titles = [title for title, peer in TITLES.items() if peer.name in peers]
    settings = {one.method: one.setting for one in before if one.method in titles}
    with stdout_to_stderr():
        settings |= bench.tuned([title for title in titles if title not in settings]) if numbers else {}
    for number in numbers:
        with stdout_to_stderr():
            rows = bench.judge(number, settings)
        yield rows


def _growth(common: Common, bench: PoseBench) -> None:
    from pipeline.quiet_stdout import stdout_to_stderr

    rows: list[dict[str, Any]] = []
    remaining = bench.growth(MOST_OBJECTS)
    _say(common, "objects  seconds  compiled before  under 1 cm")
    while len(rows) < MOST_OBJECTS:
        with stdout_to_stderr():
            rows.append(next(remaining))
        row = rows[-1]
        cells = (f"{row['objects']:>7}", f"{row['seconds']:>7.2f}", f"{row['compile_s']:>13.1f} s")
        _say(common, "  ".join((*cells, f"{_share(row['under_1cm']):>10}")))
    each = rows[-1]["seconds"] / MOST_OBJECTS
    common.report(
        {"growth": rows}, [f"{each:.2f} s an object of {MOST_OBJECTS}, {rows[0]['seconds']:.2f} s of one"]
    )


def _presences(common: Common, bench: PoseBench, numbers: range, absent: int) -> None:
    from pipeline.benchmarks.pose_presence import presence_figures
    from pipeline.quiet_stdout import stdout_to_stderr

    reported = []
    for number in numbers:
        with stdout_to_stderr():
            table = bench.presences(number, absent)
        reported += table
        said = (f"{one.shape}{'' if one.there else ' (absent)'} {one.presence:.2f}" for one in table)
        _say(common, f"table {number}: {', '.join(said)}")
    figures = presence_figures(reported)
    common.report(
        figures,
        [
            f"{figures['asked']} asked for, {figures['absent']} of them absent:"
            f" {figures['false']} found where they are not, {figures['missed']} missed",
            "presence   count  right",
            *map(_bin_line, figures["calibration"]),
        ],
    )


def _bin_line(row: dict[str, Any]) -> str:
    return f"{row['presence']:>8.2f}  {row['count']:>6}  {row['right']:>5.2f}"


def _say(common: Common, line: str) -> None:
    if not (common.as_json or common.quiet):
        click.echo(line)


def _table_line(judged: Sequence[Judged]) -> str:
    """Number, and of each method how many objects are right in how many seconds."""
    methods = dict.fromkeys(one.method for one in judged)
    cells = []
    for method in methods:
        own = [one for one in judged if one.method == method]
        right = sum(one.error_m < 0.01 for one in own)
        cells.append(f"{method} {right}/{len(own)} in {own[0].seconds:.1f} s")
    return f"table {judged[0].table}: {'; '.join(cells)}" if judged else "a table on which nothing is judged"


def _lines(document: dict[str, Any]) -> list[str]:
    if not document["methods"]:
        return ["no table was finished"]
    titles = {
        name: f"{name} ({figures['setting']})" if figures["setting"] else name
        for name, figures in document["methods"].items()
    }
    width = max(map(len, titles.values()))
    lines = [f"{document['tables']} tables"]
    for row in ("all", "on the table", "stacked"):
        lines.append(f"{row:<{width}}  objects   <5 mm  <10 mm  <20 mm     AUC  median mm")
        for name, figures in document["methods"].items():
            if row not in figures["rows"]:
                continue
            one = figures["rows"][row]
            shares = "  ".join(f"{share:>6.1%}" for share in one["accuracy"].values())
            lines.append(
                f"{titles[name]:<{width}}  {one['objects']:>7}  {shares}  {one['auc_0_10cm']:>6.1%}"
                f"  {1000 * one['median_m']:>9.1f}"
            )
    for name, figures in document["methods"].items():
        timing = f"{figures['seconds_median']:.2f} s a table (most {figures['seconds_most']:.2f})"
        edges = "".join(
            f", {_share(one['right'])} of {one['rests']} {kind} rests right"
            for kind, one in figures["edges"].items()
            if one["rests"]
        )
        lines.append(f"{titles[name]:<{width}}  {timing}{edges}")
    return lines


def _share(share: float | None) -> str:
    return "" if share is None else f"{share:.1%}"
