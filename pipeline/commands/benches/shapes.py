"""`voxscene bench shapes`: the supplement's Table 1."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

from pipeline.options import Common, common_options, words

PEERS = ("carving", "votes", "octomap", "tsdf")
POSES = ("true", "slam")
FIGURES = ("solid", "shell", "observed", "ceiling", "seconds")
COLUMNS: tuple[str, ...] = (
    "object",
    "thin",
    "poses",
    "views",
    *FIGURES,
    "supplement",
    "particles",
    "hidden_occupied",
)


@click.command(name="shapes")
@click.option("--meshes", type=click.Path(path_type=Path), required=True, metavar="DIR", help="True shapes.")
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of the meshes; metres unless BOP's.")
@click.option("--views", default="5,10,20", show_default=True, metavar="T,...", help="Numbers of views.")
@click.option("--only", metavar="TEXT", default="", help="Only the meshes whose name has this in it.")
@click.option(
    "--poses",
    default=",".join(POSES),
    show_default=True,
    metavar="KIND,...",
    help="The true poses, those that our slam finds, or both.",
)
@click.option(
    "--against",
    metavar="PEER,...",
    default=",".join(PEERS),
    show_default=True,
    help="Peers on the same frames and poses; an empty word for none.",
)
@click.option(
    "--csv", "csv_path", type=click.Path(path_type=Path, dir_okay=False), help="Write it as CSV too."
)
@common_options("learn")
def command(
    common: Common,
    meshes: Path,
    units: Any,
    views: str,
    only: str,
    poses: str,
    against: str,
    csv_path: Path | None,
) -> None:
    """Learned shapes against true meshes, filmed from rings at 25 and 55 degrees.

    \b
    solid     occupied or enclosed voxels against the solid object
    shell     their outermost layer against that of the object
    observed  voxels that some ray decided, alone
    ceiling   solid, of the true object and all voxels that no noise-free ray reaches
    paper     what Table 1 of the supplement says of the object
    """  # noqa: D301  (click reads the \b)
    from pipeline.benchmarks.shape_summary import summary
    from pipeline.benchmarks.shapes import growth, shape_rows
    from pipeline.errors import ConfigError, PipelineError
    from pipeline.jax_setup import keep_compiled_kernels
    from pipeline.meshes import load_meshes
    from pipeline.options import numbers
    from pipeline.quiet_stdout import stdout_to_stderr
    from shapes.learning.config import LearnConfig

    keep_compiled_kernels()
    peers = words("--against", against, PEERS)
    kinds: Any = words("--poses", poses, POSES)
    counts = [int(count) for count in numbers("--views", views)]
    if min(counts) < 1:
        raise ConfigError(f"--views {views}: every number must be at least 1")
    if not kinds:
        raise ConfigError("--poses: name at least one kind")
    chosen = {name: mesh for name, mesh in load_meshes(meshes, units).items() if only in name}
    if not chosen:
        raise PipelineError(f"--only {only}: no mesh has that in its name")
    config = common.settings.section("learn", LearnConfig)
    talking = not (common.as_json or common.quiet)
    rows, total = [], len(counts) * len(chosen) * len(kinds)
    if talking:
        click.echo(
            f"pitch {1000 * config.pitch_m:g} mm; the paper does not state its pitch and interior rule"
        )
        click.echo(_line(["object", "poses", "T", *FIGURES, "paper"]))
    with common.progress("shapes", "films") as progress:
        remaining = shape_rows(chosen, counts, kinds, peers, config, common.seed)
        while len(rows) < total:
            with stdout_to_stderr():
                rows.append(next(remaining))
            if talking:
                click.echo(_row_line(rows[-1].figures))
            progress(len(rows), total)
        with stdout_to_stderr():
            grown = growth(chosen[min(chosen)], config, common.seed)
    document = summary(rows, grown, config.pitch_m)
    if csv_path is not None:
        _write_csv(csv_path, document["rows"])
    common.report(document, _summary_lines(document))


def _row_line(row: dict[str, Any]) -> str:
    name = row["object"] + (" (thin)" if row["thin"] else "")
    paper = "" if row["supplement"] is None else f"{row['supplement']:.3f}"
    if "failed" in row:
        return _line([name, row["poses"], row["views"], f"failed: {row['failed']}"])
    return _line([name, row["poses"], row["views"], *(f"{row[key]:.3f}" for key in FIGURES), paper])


def _summary_lines(document: dict[str, Any]) -> list[str]:
    lines = [""]
    for mean in document["means"]:
        name = f"mean, {mean['walls']} walls ({mean['objects']})"
        cells = [f"{mean[key]:.3f}" for key in FIGURES]
        lines.append(_line([name, mean["poses"], mean["views"], *cells]))
        for peer, best in mean["peers"].items():
            lines.append(_line([f"  {peer}", "", "", f"{best['solid']:.3f}"]) + f"  {best['setting']}")
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
    return f"{name:<36}{poses:<6}{views:>3}" + "".join(f"{cell:>10}" for cell in rest)


def _write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    from pipeline.atomic import atomic_path

    with atomic_path(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
