"""`voxscene bench shapes`: the supplement's Table 1."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import click

from pipeline.options import Common, common_options

PEERS = ("carving", "octomap", "tsdf")


@click.command(name="shapes")
@click.option("--meshes", type=click.Path(path_type=Path), required=True, metavar="DIR", help="True shapes.")
@click.option("--units", type=click.Choice(["m", "mm"]), help="Of the meshes; metres unless BOP's.")
@click.option("--views", default="5,10,20", show_default=True, metavar="T,...", help="Numbers of views.")
@click.option("--only", metavar="TEXT", default="", help="Only the meshes whose name has this in it.")
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
    against: str,
    csv_path: Path | None,
) -> None:
    """Learned shapes against true meshes, filmed from rings at 25 and 55 degrees, with the true poses.

    \b
    solid     occupied or enclosed voxels against the solid object
    shell     their outermost layer against that of the object
    observed  voxels that some ray decided, alone
    ceiling   solid, of the true object and all voxels that no noise-free ray reaches
    """  # noqa: D301  (click reads the \b)
    from pipeline.benchmarks.shapes import measure_shapes
    from pipeline.errors import ConfigError, PipelineError
    from pipeline.jax_setup import keep_compiled_kernels
    from pipeline.meshes import load_meshes
    from pipeline.options import numbers
    from pipeline.quiet_stdout import stdout_to_stderr
    from shapes.learning.config import LearnConfig

    keep_compiled_kernels()
    peers = [name.strip() for name in against.split(",") if name.strip()]
    unknown = [name for name in peers if name not in PEERS]
    if unknown:
        raise PipelineError(f"--against: no peer {unknown[0]!r}; there are {', '.join(PEERS)}")
    counts = [int(count) for count in numbers("--views", views)]
    if min(counts) < 1:
        raise ConfigError(f"--views {views}: every number must be at least 1")
    chosen = {name: mesh for name, mesh in load_meshes(meshes, units).items() if only in name}
    if not chosen:
        raise PipelineError(f"--only {only}: no mesh has that in its name")
    config = common.settings.section("learn", LearnConfig)
    with common.progress("shapes", "objects") as progress, stdout_to_stderr():
        document = measure_shapes(chosen, counts, peers, config, common.seed, progress)
    if csv_path is not None:
        _write_csv(csv_path, document)
    common.report(document, _lines(document))


def _lines(document: dict[str, Any]) -> list[str]:
    lines = [
        f"pitch {1000 * document['pitch_m']:g} mm; the supplement's Table 1: mean "
        f"{document['supplement_iou']}, pitch and interior rule not stated"
    ]
    names = ["object", "T", "solid", "shell", "observed", "ceiling", "seconds"]
    lines.append(_line(names))
    figures = ("solid", "shell", "observed", "ceiling", "seconds")
    for row in document["rows"]:
        name = row["object"] + (" (thin)" if row["thin"] else "")
        lines.append(_line([name, row["views"], *(f"{row[key]:.3f}" for key in figures)]))
    for mean in document["means"]:
        name = f"mean, {mean['walls']} ({mean['objects']})"
        lines.append(_line([name, mean["views"], *(f"{mean[key]:.3f}" for key in figures)]))
        for peer, best in mean["peers"].items():
            lines.append(_line([f"  {peer}", "", f"{best['solid']:.3f}"]) + f"  {best['setting']}")
    lines.append(_line(["calibration of seen voxels", "T", "Brier", "log loss", "ECE"]))
    for count, methods in document["calibration"].items():
        for method, one in methods.items():
            cells = (f"{one[key]:.4f}" for key in ("brier", "log_loss", "ece"))
            lines.append(_line([method, count, *cells]))
    return lines


def _line(cells: list[Any]) -> str:
    return f"{cells[0]:<36}{cells[1]:>4}" + "".join(f"{cell:>10}" for cell in cells[2:])


def _write_csv(path: Path, document: dict[str, Any]) -> None:
    from pipeline.atomic import atomic_path

    columns = [
        "object",
        "thin",
        "views",
        "solid",
        "shell",
        "observed",
        "ceiling",
        "seconds",
        "hidden_occupied",
    ]
    with atomic_path(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(document["rows"])
