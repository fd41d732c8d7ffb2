"""`voxscene bench slam`: tracking errors on real recordings and in seeded rooms, peers beside it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from pipeline.options import AnyPath, Common, OutputFile, common_options, words
from pipeline.peers import PEERS
from pipeline.progress import tell


@click.command(name="slam")
@click.option("--rooms", type=click.IntRange(min=1), default=10, show_default=True, help="Rooms of each row.")
@click.option(
    "--runs",
    type=click.IntRange(min=0),
    default=300,
    show_default=True,
    help="Short runs, one frame of each, in which it is counted how often the truth lies inside.",
)
@click.option(
    "--distortion",
    type=click.FloatRange(0, 0.01),
    default=0.0,
    show_default=True,
    metavar="SD",
    help="Of the field, in 1/m, by which the inverse depths of each short run's camera err in all frames.",
)
@click.option(
    "--hour",
    "hour_frames",
    type=click.IntRange(min=5000),
    default=100_000,
    show_default=True,
    metavar="FRAMES",
    help="Length of the sequence of twenty rooms, which --only hour alone tracks: it takes hours.",
)
@click.option("--only", metavar="TEXT", default="", help="Only the rows whose name has this in it.")
@click.option(
    "--against",
    metavar="PEER,...",
    default=",".join(PEERS),
    show_default=True,
    help="Peers to run on the same frames; an empty word for none.",
)
@click.option(
    "--data",
    type=AnyPath(file_okay=False),
    envvar="VOXSCENE_DATA",
    default=Path("data"),
    show_default=True,
    help="Folder with sevenscenes_redkitchen and apc_shelf_handheld [env: VOXSCENE_DATA].",
)
@click.option("--csv", "csv_path", type=OutputFile(), help="Write it as CSV too.")
@common_options(computes=True)
def command(
    common: Common,
    rooms: int,
    runs: int,
    distortion: float,
    hour_frames: int,
    only: str,
    against: str,
    data: Path,
    csv_path: Path | None,
) -> None:
    """Tracking errors, in real recordings and seeded rooms.

    Bare and furnished rooms, views round an object and whole circles; a corridor round a block of rooms;
    things that move before the camera or with it. Every peer is tuned, in rooms of other seeds or on the real
    recording itself. With all rows, peers and ten rooms it takes more than an hour. "told" is the share of
    frames that are within 2 cm, lost, or inside their 95% region: on average, and in the worst run.
    """
    from pipeline.benchmarks.corridors import corridor_rows
    from pipeline.benchmarks.moving_cases import moving_rows
    from pipeline.benchmarks.slam import slam_rows
    from pipeline.benchmarks.slam_cases import real_rows, short_walk, synthetic_rows
    from pipeline.benchmarks.slam_coverage import ROW, coverage_row
    from pipeline.benchmarks.slam_hour import ROW as HOUR_ROW
    from pipeline.benchmarks.slam_hour import hour_row
    from pipeline.errors import PipelineError
    from pipeline.quiet_stdout import stdout_to_stderr

    peers = words("--against", against, PEERS)
    every = [*real_rows(data), *synthetic_rows(), *corridor_rows(), *moving_rows()]
    rows = [row for row in every if only in row.name]
    counted, timed = runs > 0 and only in ROW, len(only) > 0 and only in HOUR_ROW
    if not rows and not counted and not timed:
        raise PipelineError(f"--only {only}: no row has that in its name")
    talking = not (common.as_json or common.quiet)
    if talking:
        tell(_line(HEADINGS))
    measured: list[dict[str, Any]] = []
    with common.progress("slam", "recordings") as progress:
        remaining = slam_rows(rows, peers, rooms, common.seed, progress)
        while len(measured) < len(rows):
            with stdout_to_stderr():
                measured.append(next(remaining))
            if talking:
                for cells in _cells(measured[-1]):
                    tell(_line(cells))
    if counted:
        with common.progress("coverage", "runs") as progress, stdout_to_stderr():
            walk = partial(short_walk, distortion_per_m=distortion)
            measured.append(coverage_row(runs, common.seed, progress, walk))
        if talking:
            for cells in _cells(measured[-1]):
                tell(_line(cells))
    if timed:
        with common.progress("hour", "frames") as progress, stdout_to_stderr():
            measured.append(hour_row(hour_frames, common.seed, progress))
        if talking:
            for cells in _cells(measured[-1]):
                tell(_line(cells))
    document = {"rows": measured}
    common.report(document, ["errors: median (least to most) over the runs that were not lost"])
    if csv_path is not None:
        _write_csv(csv_path, document)


HEADINGS = ["row", "tracker", "error", "unit", "rotation deg", "lost", "frames/s", "in 95%", "told"]
WIDTHS = (34, 22, 24, 22, 22, 5, 8, 6, 10)


def _cells(row: dict[str, Any]) -> list[list[str]]:
    """One line for each tracker."""
    if "skipped" in row:
        return [[row["row"], "skipped", row["skipped"], "", "", "", "", "", ""]]
    if "coverage" in row:
        shares = "; ".join(_share(level, figures) for level, figures in row["coverage"].items())
        far = f"{row['far_off_untold']} of {row['runs']} over 10 cm off, untold"
        worst = f"worst of each run {1000 * row['median_worst_m']:.1f} mm (median)"
        return [
            [row["row"], "voxscene", shares, row["unit"], "", "", "", "", ""],
            [row["row"], "voxscene", f"{worst}; {far}", "", "", "", "", "", ""],
        ]
    if "peak_mb" in row:
        return [[row["row"], "voxscene", one, "", "", "", "", "", ""] for one in _hour_lines(row)]
    scale = 1000 if row["unit"].startswith("mm") else 100
    return [
        [
            row["row"],
            name,
            _spread(figures.get("error"), scale),
            row["unit"],
            _spread(figures.get("rotation_deg"), 1),
            f"{figures['lost_runs']}/{row['runs']}",
            _median(figures.get("frames_per_second"), "{:.1f}"),
            _median(figures.get("coverage_95"), "{:.0%}"),
            _told(figures.get("told")),
        ]
        for name, figures in row["trackers"].items()
    ]


def _hour_lines(row: dict[str, Any]) -> list[str]:
    cost = f"{row['frames']} frames, {row['keyframes']} keyframes: at most {row['peak_mb']:.0f} MB"
    kernels = f"{row['kernels_after_start']} kernels compiled after frame 1,000"
    speed = f"the last tenth at {row['last_to_first_tenth']:.2f} of the first one's rate"
    errors = " ".join(f"{name} {100 * row[f'{name}_m']:.1f}" for name in ("median", "worst", "end"))
    told = f"told {100 * row['told_end_m']:.1f} at the end, {row['lost_frames']} lost"
    return [f"{cost}; {kernels}; {speed}", f"cm off: {errors}; {told}"]


def _line(cells: list[str]) -> str:
    return "  ".join(cell.ljust(width) for cell, width in zip(cells, WIDTHS, strict=True)).rstrip()


def _share(level: str, figures: dict[str, float]) -> str:
    return f"{figures['share']:.1%} in {float(level):.0%} ({figures['least']:.1%} to {figures['most']:.1%})"


def _spread(figure: dict[str, float] | None, scale: float) -> str:
    if figure is None:
        return "lost"
    middle, least, most = (scale * figure[name] for name in ("median", "least", "most"))
    return f"{middle:.2f} ({least:.2f} to {most:.2f})"


def _median(figure: dict[str, float] | None, form: str) -> str:
    return "" if figure is None else form.format(figure["median"])


def _told(figure: dict[str, float] | None) -> str:
    """The mean over the runs, and the worst one."""
    return "" if figure is None else f"{figure['mean']:.0%} ({figure['least']:.0%})"


def _write_csv(path: Path, document: dict[str, Any]) -> None:
    from pipeline.atomic import write_table

    cells = (dict(zip(HEADINGS, one, strict=True)) for row in document["rows"] for one in _cells(row))
    write_table(path, HEADINGS, cells)
