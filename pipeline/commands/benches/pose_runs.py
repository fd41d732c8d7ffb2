"""What `voxscene bench poses` runs: images judged by methods, or one of its other measurements."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from pipeline.errors import PipelineError
from pipeline.executors import executors_for
from pipeline.options import Common, words
from pipeline.progress import tell
from pipeline.synthesis.challenging_kinds import KINDS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pipeline.benchmarks.pose_methods import Method
    from pipeline.benchmarks.pose_sources import PoseSource
    from pipeline.mesh_source import MeshSource

MOST_OBJECTS = 10


@dataclass(frozen=True, kw_only=True)
class PoseFiles:
    """Where `bench poses` writes, each where it was asked for."""

    keep: Path | None
    """Folder of rows; what is there is not run again."""
    csv: Path | None
    bop: Path | None
    curves: Path | None
    sheets: Path | None


def pose_source(
    common: Common,
    shapes: MeshSource,
    objects: int,
    numbers: tuple[int, ...],
    challenging: int | None,
    kinds: str,
    seen: tuple[float, tuple[int, int]],
    data: Path | None,
    split: str,
) -> PoseSource:
    """Synthetic tables, images in which objects are hard to find, or a data set."""
    from pipeline.benchmarks.pose_sources import BopImages, Tables, challenging_images
    from pipeline.synthesis.challenging_scene import ChallengingScene

    if data is not None:
        return BopImages(root=data.resolve(), split=split, shapes=shapes)
    if challenging is not None:
        chosen = tuple(words("--kinds", kinds, list(KINDS)))
        return challenging_images(
            shapes, chosen, challenging, ChallengingScene().seen_worse(*seen), common.seed
        )
    return Tables(shapes=shapes, objects=objects, seed=common.seed, numbers=numbers)


def world_source(
    common: Common, shapes: MeshSource, others: MeshSource | None, numbers: tuple[int, ...]
) -> PoseSource:
    """Worlds like real ones; `others` are meshes of things in them that nobody asks for."""
    from pipeline.benchmarks.pose_sources import Worlds
    from pipeline.synthesis.worlds import WorldScene

    return Worlds(shapes=shapes, others=others, scene=WorldScene(), seed=common.seed, numbers=numbers)


def other_methods(
    shapes: MeshSource, source: PoseSource, peers: Sequence[str], results: Sequence[tuple[str, Path]]
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


def judge(
    common: Common,
    source: PoseSource,
    methods: Sequence[Method],
    workers: int | str,
    files: PoseFiles,
    report: tuple[Callable[..., dict[str, Any]], Callable[[dict[str, Any]], list[str]]],
    *,
    watch: bool,
) -> None:
    """Images judged, and what `report` makes of the rows and seconds: figures, and lines of these."""
    from pipeline.benchmarks.bop_results import write_results
    from pipeline.benchmarks.pose_report import image_line
    from pipeline.benchmarks.pose_rows import write_csv
    from pipeline.benchmarks.poses import RemainingTime, collected, judged_images, kept_images

    figures, lines = report
    executors, at_once = executors_for(workers)
    done = list(kept_images(source, methods, files.keep)) if watch else []
    try:
        with common.progress("poses", "images") as progress:
            remaining = RemainingTime(lambda line: _say(common, line), progress)
            if not watch:
                for key, found in judged_images(source, methods, executors, at_once, files.keep, remaining):
                    done.append((key, found))
                    _say(common, image_line(found))
    finally:
        judged, seconds = collected(done)
        document = figures(judged, seconds)
        common.report(document, lines(document))
        if files.csv and judged:
            write_csv(files.csv, judged)
        if files.bop and judged:
            title = methods[0].title
            rows = [one for one in judged if one.method == title]
            write_results(files.bop, rows, source.shapes.ids, seconds[title])
    if files.curves:
        from pipeline.figures.accuracy_curves import draw_curves

        draw_curves(judged, files.curves)
    if files.sheets:
        from pipeline.figures.pose_sheets import draw_sheets

        for path in draw_sheets(judged, source, files.sheets):
            _say(common, str(path))


def compare_proposals(
    common: Common,
    source: PoseSource,
    sources: Sequence[str],
    workers: int | str,
    files: PoseFiles,
    *,
    watch: bool,
) -> None:
    """The best hypothesis of each object, by where the search took its poses from."""
    from functools import partial

    from pipeline.benchmarks.pose_proposals import (
        Source,
        proposal_figures,
        proposal_lines,
        proposal_methods,
    )

    methods = proposal_methods(cast("Sequence[Source]", sources), common.seed)
    report = partial(proposal_figures, sources=sources), proposal_lines
    judge(common, source, methods, workers, files, report, watch=watch)


def measure_growth(common: Common, shapes: MeshSource) -> None:
    """Seconds of a table against its number of objects."""
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


def measure_presences(
    common: Common, shapes: MeshSource, objects: int, numbers: Sequence[int], absent: int
) -> None:
    """Presences told where some of the shapes asked for are not there."""
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


def compare_lookalikes(common: Common, numbers: Sequence[int]) -> None:
    """Which of two alike is there, by depth alone and with colours."""
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


def count_copies(common: Common, shapes: MeshSource, numbers: Sequence[int]) -> None:
    """How many things of one shape are told, of the two or three that are there."""
    from pipeline.benchmarks.copies import copies_figures, copies_lines, judge_copies
    from pipeline.quiet_stdout import stdout_to_stderr

    rows = []
    for number in numbers:
        with stdout_to_stderr():
            row = judge_copies(shapes, number, common.seed)
        if row is not None:
            rows.append(row)
            _say(
                common,
                f"table {number}, {row.shape}: {row.found} of {row.there} told with"
                f" {max(row.numbers):.2f}, {row.right} right",
            )
    figures = copies_figures(rows)
    common.report(figures, copies_lines(figures))


def judge_decoys(common: Common, shapes: MeshSource, numbers: Sequence[int]) -> None:
    """Whether what is asked for is laid into a thing that nobody asks for."""
    from pipeline.benchmarks.decoys import decoy_figures, decoy_lines, judge_decoy
    from pipeline.quiet_stdout import stdout_to_stderr

    rows = []
    for number in numbers:
        with stdout_to_stderr():
            row = judge_decoy(shapes, number, common.seed)
        if row is not None:
            rows.append(row)
            place = f"{1000 * row.error_m:.1f} mm off" if row.there else "absent"
            said = f"presence {row.presence:.2f}, truth ahead by {row.advantage:.1f} nats"
            _say(common, f"table {number}, {row.kind}, {row.shape}: {place}, {said}")
    figures = decoy_figures(rows)
    common.report(figures, decoy_lines(figures))


def judge_drawn_tables(
    common: Common, shapes: MeshSource, numbers: Sequence[int], csv_path: Path | None
) -> None:
    """Presences and poses of tables that are drawn from the model itself."""
    from dataclasses import asdict, fields

    from pipeline.atomic import write_table
    from pipeline.benchmarks.calibration import (
        CalibrationRow,
        calibration_figures,
        calibration_lines,
        judge_drawn,
    )
    from pipeline.quiet_stdout import stdout_to_stderr

    rows = []
    for number in numbers:
        with stdout_to_stderr():
            table = judge_drawn(shapes, number, common.seed)
        rows += table
        said = (f"{one.shape}{'' if one.there else ' (absent)'} {one.presence:.2f}" for one in table)
        _say(common, f"table {number}: {', '.join(said) or 'nothing to parse'}")
        if csv_path:
            write_table(csv_path, [field.name for field in fields(CalibrationRow)], map(asdict, rows))
    figures = calibration_figures(rows)
    common.report(figures, calibration_lines(figures))


def _say(common: Common, line: str) -> None:
    if not (common.as_json or common.quiet):
        tell(line)
