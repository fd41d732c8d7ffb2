"""`voxscene bench shapes`: the supplement's Table 1."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

from pipeline.errors import ConfigError, PipelineError
from pipeline.options import AnyPath, Common, OutputFile, common_options, counts, goes_on, words
from pipeline.peers import VOXEL_MAPS
from pipeline.progress import tell

POSES = ("true", "slam", "orbit")
FIGURES = ("solid", "shell", "observed", "ceiling", "ratio", "reachable", "touched")
WALLS = ("wall_mm", "true_wall_mm")
SCORES = ("brier", "log_loss", "ece")
OURS = (*FIGURES[:-2], "reach", "touched", "wall mm", "true mm")
TITLES = (*OURS, *VOXEL_MAPS, "Brier", "log loss", "ECE", "seconds")
COLUMNS: tuple[str, ...] = (
    *("object", "thin", "conditions", "noise_free", "poses", "views", *FIGURES, *WALLS, *VOXEL_MAPS, *SCORES),
    *("walls_drawn", "seconds", "supplement", "particles", "hidden_occupied", "failed"),
)


@click.command(name="shapes")
@click.option("--meshes", type=AnyPath(), metavar="DIR", help="True shapes, instead of the built-in objects.")
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of the meshes; metres unless BOP's.")
@click.option("--views", metavar="T,...", help="Numbers of views; 5,10,20, or the paper's 5.")
@click.option(
    "--only",
    metavar="TEXT,...",
    default="",
    help="A slice of the table: only the meshes whose name has one of these in it.",
)
@click.option(
    "--keep",
    type=AnyPath(file_okay=False),
    metavar="DIR",
    help="Rows are kept there one by one, and taken from there where they were made with the same settings.",
)
@click.option(
    "--growth/--no-growth", default=True, show_default=True, help="Also time falling pitches, of one object."
)
@click.option(
    "--poses",
    metavar="KIND,...",
    help="true; those that our slam finds (slam), or finds where the distance is known and the object's "
    "first pose given (orbit). true,slam by default, orbit under the paper's conditions.",
)
@click.option(
    "--conditions",
    type=click.Choice(["rings", "paper"]),
    default="rings",
    show_default=True,
    help="Sequences from two rings in a furnished room, or as in the paper: one circle of 5 in a bare room.",
)
@click.option("--noise-free", is_flag=True, help="The sequences measure exactly.")
@click.option(
    "--against",
    metavar="PEER,...",
    default=",".join(VOXEL_MAPS),
    show_default=True,
    help="Peers on the same frames and poses; an empty word for none.",
)
@click.option("--csv", "csv_path", type=OutputFile(), help="Write it as CSV too.")
@common_options("learn", computes=True)
def command(
    common: Common,
    meshes: Path | None,
    units: Any,
    views: str | None,
    only: str,
    keep: Path | None,
    growth: bool,
    poses: str | None,
    conditions: Any,
    noise_free: bool,
    against: str,
    csv_path: Path | None,
) -> None:
    """Learned shapes against true meshes.

    The objects are filmed from rings at 25 and 55 degrees.

    \b
    solid     occupied or enclosed voxels against the solid object
    shell     their outermost layer against that of the object
    observed  voxels that some ray decided, alone
    ceiling   solid, of the true object and all voxels that no noise-free ray reaches
    ratio     solid to ceiling
    reachable solid against the true object and all voxels that no noise-free ray reaches: 1 where all that
              these views can show was learned
    touched   voxels that the learned surface touches or fills against those of the true one
    wall mm   median thickness of the learned surface where the object is thinner than a voxel and some view
              sees either side; true mm is that of the object there
    peers     solid of each, in a row at its best setting for that object, in means at its best for all
    Brier ... of voxels that some ray decided, within three voxels of the true surface
    paper     what Table 1 of the supplement says of the object
    thin      a tenth of the object's surface belongs to walls thinner than the pitch

    Each row is printed when it is done; an interrupted run prints the means of those before.
    """  # noqa: D301  (click reads the \b)
    from pipeline.benchmarks.shape_summary import summary
    from pipeline.benchmarks.shapes import growth as growth_of
    from pipeline.benchmarks.shapes import shape_rows
    from pipeline.mesh_source import MeshSource
    from pipeline.quiet_stdout import stdout_to_stderr
    from shapes.learning.config import LearnConfig

    if keep:
        goes_on()
    peers = _installed(words("--against", against, VOXEL_MAPS))
    paper = conditions == "paper"
    kinds: list[Any] = words("--poses", poses or ("orbit" if paper else "true,slam"), POSES)
    if not kinds:
        raise ConfigError("--poses: name at least one kind")
    filmed = counts("--views", views or ("5" if paper else "5,10,20"))
    all_meshes = MeshSource.of(meshes, units).meshes
    chosen = _chosen(all_meshes, only)
    config = common.settings.section("learn", LearnConfig)
    talking = not (common.as_json or common.quiet)
    if talking:
        tell(f"pitch {1000 * config.pitch_m:g} mm; the paper does not state its pitch and interior rule")
        tell(_line(["object", "poses", "T", *TITLES, "paper"]))
    rows, grown, total = [], [], len(filmed) * len(chosen) * len(kinds)
    remaining = shape_rows(
        all_meshes, chosen, filmed, kinds, peers, config, common.seed, keep, conditions, noise_free=noise_free
    )
    try:
        with common.progress("shapes", "films") as progress:
            while len(rows) < total:
                with stdout_to_stderr():
                    rows.append(next(remaining))
                if talking:
                    tell(_row_line(rows[-1].figures))
                progress(len(rows), total)
            if growth:
                with stdout_to_stderr():
                    grown = growth_of(all_meshes[chosen[0]], config, common.seed)
    finally:
        if rows:
            document = summary(rows, grown, config.pitch_m)
            common.report(document, _summary_lines(document))
            if csv_path is not None:
                _write_csv(csv_path, document["rows"])


def _chosen(meshes: Iterable[str], only: str) -> list[str]:
    """The names that have one of the words in them."""
    chosen = [name for name in sorted(meshes) if any(word in name for word in only.split(","))]
    if not chosen:
        raise PipelineError(f"--only {only}: no mesh has that in its name")
    return chosen


def _installed(peers: list[str]) -> list[str]:
    """The peers without OctoMap where it is not installed, which is told on stderr."""
    if "octomap" not in peers or importlib.util.find_spec("octomap") is not None:
        return peers
    tell("octomap is left out: pip install 'voxscene[bench]' adds it", err=True)
    return [peer for peer in peers if peer != "octomap"]


def _row_line(row: dict[str, Any]) -> str:
    name = row["object"] + (" (thin)" if row["thin"] else "")
    if "failed" in row:
        return _line([name, row["poses"], row["views"], f"  failed: {row['failed']}"])
    flat = _with_peers(row)
    cells = [flat[key] for key in (*FIGURES, *WALLS, *VOXEL_MAPS)]
    cells += [row[score] for score in SCORES] + [row["seconds"], row["supplement"]]
    return _line([name, row["poses"], row["views"], *map(_number, cells)])


def _with_peers(row: dict[str, Any]) -> dict[str, Any]:
    """A row and, by peer, what it reached at its best setting for the object."""
    best = {peer: max(one["solid"] for one in settings.values()) for peer, settings in row["peers"].items()}
    return dict.fromkeys(VOXEL_MAPS) | row | best


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def _summary_lines(document: dict[str, Any]) -> list[str]:
    lines = [""]
    for mean in document["means"]:
        name = f"mean, {mean['walls']} walls ({mean['objects']})"
        peers = {peer: best["solid"] for peer, best in mean["peers"].items()}
        cells = [mean[key] for key in (*FIGURES, *WALLS)] + [peers.get(peer) for peer in VOXEL_MAPS]
        cells += [None] * len(SCORES)
        lines.append(_line([name, mean["poses"], mean["views"], *map(_number, [*cells, mean["seconds"]])]))
        if mean["walls"] == "all":
            lines += [f"  {peer}: {best['setting']}" for peer, best in mean["peers"].items()]
    lines.append(_line(["calibration of seen voxels", "poses", "T", "Brier", "log loss", "ECE"]))
    for one in document["calibration"]:
        cells = (f"{one[key]:.4f}" for key in ("brier", "log_loss", "ece"))
        lines.append(_line([one["method"], one["poses"], one["views"], *cells]))
    lines.append(_line(["growth", "", "", "voxels", "seconds"]))
    for one in document["growth"]["by_pitch"]:
        cells = [one["voxels"], f"{one['seconds']:.2f}"]
        lines.append(_line([f"pitch {1000 * one['pitch_m']:g} mm", "", 10, *cells]))
    for name, of in (("1/pitch", "pitch_exponent"), ("T", "views_exponent")):
        if document["growth"][of] is not None:
            lines.append(f"seconds grow as {name} to the power of {document['growth'][of]:.2f}")
    lines += [
        f"{one['object']} falls by {one['fall']:.3f} at {one['views']} views, {one['poses']} poses"
        for one in document["falls"]
    ]
    return lines


def _line(cells: Iterable[Any]) -> str:
    name, poses, views, *rest = cells
    return f"{name:<38} {poses:<5}{views:>3}" + "".join(f"{cell:>9}" for cell in rest)


def _write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    from pipeline.atomic import write_table

    write_table(path, COLUMNS, map(_with_peers, rows))
