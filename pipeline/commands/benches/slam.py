"""`voxscene bench slam`: tracking errors on real recordings and in seeded rooms, peers beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click

from pipeline.options import AnyPath, Common, OutputFile, common_options, words
from pipeline.peers import PEERS
from pipeline.progress import Report, tell


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
@click.option(
    "--corridor",
    "corridor_m",
    type=click.FloatRange(8, 200),
    default=20.0,
    show_default=True,
    metavar="METRES",
    help="Length of the corridors, ten frames a metre.",
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
    corridor_m: float,
    only: str,
    against: str,
    data: Path,
    csv_path: Path | None,
) -> None:
    """Tracking errors, in real recordings and seeded rooms.

    Bare and furnished rooms, views round an object and whole circles; a corridor round a block of rooms;
    things that move before the camera or with it. Every peer is tuned, in rooms of other seeds or on the real
    recording itself. With all rows, peers and ten rooms it takes more than an hour. "told" is the share of
    frames that are within 2 cm, lost, or inside their 95% region: on average, and in the worst run. CPU
    time is the median over the frames while they are tracked. Of the kitchen also: what refinement leaves of
    a drift of its keyframes, and by how much less overlapping frames of one half disagree where they are
    corrected by the distortion that was learned on the other.
    """
    from pipeline.benchmarks.corridors import corridor_rows
    from pipeline.benchmarks.moving_cases import moving_rows
    from pipeline.benchmarks.slam import slam_rows
    from pipeline.benchmarks.slam_cases import real_rows, synthetic_rows
    from pipeline.errors import PipelineError
    from pipeline.quiet_stdout import stdout_to_stderr

    peers = words("--against", against, PEERS)
    every = [*real_rows(data), *synthetic_rows(), *corridor_rows(corridor_m), *moving_rows()]
    rows = [row for row in every if only in row.name]
    others = [
        one for one in _other_rows(data, runs, distortion, hour_frames, common.seed) if one.is_asked(only)
    ]
    if not rows and not others:
        raise PipelineError(f"--only {only}: no row has that in its name")
    measured: list[dict[str, Any]] = []

    talking = not (common.as_json or common.quiet)

    def add(row: dict[str, Any]) -> None:
        measured.append(row)
        if talking:
            for cells in _cells(row):
                tell(_line(cells))

    if talking:
        tell(_line(HEADINGS))
    with common.progress("slam", "recordings") as progress:
        remaining = slam_rows(rows, peers, rooms, common.seed, progress)
        while len(measured) < len(rows):
            with stdout_to_stderr():
                found = next(remaining)
            add(found)
    for one in others:
        with common.progress("slam", one.counted) as progress, stdout_to_stderr():
            found = one.measure(progress)
        add(found)
    document = {"rows": measured}
    common.report(document, ["errors: median (least to most) over the runs that were not lost"])
    if csv_path is not None:
        _write_csv(csv_path, document)


@dataclass(frozen=True)
class _OtherRow:
    """A row that is no table of trackers.

    Attributes:
        name: of the row.
        counted: what its progress counts.
        measure: the row, given where progress is told.
        is_long: measured only where it is named.
    """

    name: str
    counted: str
    measure: Callable[[Report], dict[str, Any]]
    is_long: bool = False

    def is_asked(self, only: str) -> bool:
        return only in self.name and not (self.is_long and not only)


def _other_rows(data: Path, runs: int, distortion: float, hour_frames: int, seed: int) -> list[_OtherRow]:
    from pipeline.benchmarks.slam_cases import kitchen, short_walk
    from pipeline.benchmarks.slam_coverage import ROW, coverage_row
    from pipeline.benchmarks.slam_hour import ROW as HOUR_ROW
    from pipeline.benchmarks.slam_hour import hour_row
    from pipeline.benchmarks.slam_refinement import DRIFT_ROW, HALVES_ROW, drift_row, halves_row

    walk = partial(short_walk, distortion_per_m=distortion)
    coverage = _OtherRow(ROW, "runs", lambda report: coverage_row(runs, seed, report, walk))
    return [
        _OtherRow(DRIFT_ROW, "optima", lambda report: drift_row(kitchen(data, 10), seed, report)),
        _OtherRow(HALVES_ROW, "trajectories", lambda report: halves_row(kitchen(data, 5), report)),
        *([coverage] if runs > 0 else []),
        _OtherRow(HOUR_ROW, "frames", lambda report: hour_row(hour_frames, seed, report), is_long=True),
    ]


HEADINGS = [
    *("row", "tracker", "error", "unit", "rotation deg", "lost", "frames/s", "CPU ms/frame", "in 95%", "told")
]
WIDTHS = (34, 22, 24, 22, 22, 5, 8, 12, 6, 10)


def _cells(row: dict[str, Any]) -> list[list[str]]:
    """One line for each tracker."""
    if "skipped" in row:
        return [_text(row, "skipped", row["skipped"])]
    for figure, lines in _LINES.items():
        if figure in row:
            return [_text(row, "voxscene", line) for line in lines(row)]
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
            _median(figures.get("processor_ms_a_frame"), "{:.0f}"),
            _median(figures.get("coverage_95"), "{:.0%}"),
            _told(figures.get("told")),
        ]
        for name, figures in row["trackers"].items()
    ]


def _text(row: dict[str, Any], tracker: str, text: str) -> list[str]:
    return [row["row"], tracker, text, *[""] * (len(HEADINGS) - 3)]


def _coverage_lines(row: dict[str, Any]) -> list[str]:
    shares = "; ".join(_share(level, figures) for level, figures in row["coverage"].items())
    far = f"{row['far_off_untold']} of {row['runs']} over 10 cm off, untold"
    worst = f"worst of each run {1000 * row['median_worst_m']:.1f} mm (median)"
    return [f"{row['unit']}: {shares}", f"{worst}; {far}"]


def _drift_lines(row: dict[str, Any]) -> list[str]:
    return [
        f"{row['keyframes']} keyframes, up to {100 * run['put_in_m']:.0f} cm put in: "
        f"{1000 * run['left_m']:.1f} mm from the optimum without it"
        for run in row["drift"]
    ]


def _halves_lines(row: dict[str, Any]) -> list[str]:
    return [
        f"half {number}, {row['frames']} frames, gaps between them: "
        + "; ".join(
            f"{name} {1000 * half[f'{figure}_m']:.1f} mm, corrected "
            f"{1000 * half[f'{figure}_corrected_m']:.1f} "
            f"({1 - half[f'{figure}_corrected_m'] / half[f'{figure}_m']:.0%} less)"
            for figure, name in (("rms", "root mean square"), ("median", "median"))
        )
        for number, half in enumerate(row["halves"], 1)
    ]


def _hour_lines(row: dict[str, Any]) -> list[str]:
    cost = f"{row['frames']} frames, {row['keyframes']} keyframes: at most {row['peak_mb']:.0f} MB"
    kernels = f"{row['kernels_after_start']} kernels compiled after frame 1,000"
    speed = f"the last tenth at {row['last_to_first_tenth']:.2f} of the first one's rate"
    errors = " ".join(f"{name} {100 * row[f'{name}_m']:.1f}" for name in ("median", "worst", "end"))
    told = f"told {100 * row['told_end_m']:.1f} at the end, {row['lost_frames']} lost"
    return [f"{cost}; {kernels}; {speed}", f"cm off: {errors}; {told}"]


_LINES = {"coverage": _coverage_lines, "peak_mb": _hour_lines, "drift": _drift_lines, "halves": _halves_lines}
"""How rows are told that are no table of trackers, by a figure that they alone have."""


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
