"""A comparison of trajectories as files: TUM for other programs, a table, pictures, and Rerun's view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from pipeline.atomic import atomic_path, check_replaced, write_text
from pipeline.errors import PipelineError
from pipeline.evaluation.trajectories import ComparedTrajectory
from pipeline.evaluation.trajectory_errors import rotation_errors_rad
from pipeline.publishing.trajectory_files import seconds_text, tum_lines
from pipeline.report import charts
from pipeline.views.error_view import write_error_rrd
from slam.result import SlamResult

ERRORS = "errors.csv"
HEADER = "frame,time_s,position_error_m,rotation_error_rad,position_std_m,lost"


def check_comparison(out: Path) -> None:
    """Refuse a folder whose errors.csv is another table, before any work.

    Raises:
        PipelineError: it is.
    """

    def is_one(path: Path) -> bool:
        with path.open("rb") as file:
            return file.readline().rstrip() == HEADER.encode()

    check_replaced(out / ERRORS, "table of eval slam", is_one)


def write_comparison(
    out: Path, result: SlamResult, ours: ComparedTrajectory, others: Sequence[ComparedTrajectory]
) -> list[Path]:
    """Write a comparison into a folder, made if it is not there.

    reference.tum and estimate.tum have one line for each frame compared, others' estimates stand in
    estimate.NAME.tum; errors.csv is after the best rigid alignment, as are error.png, path.png, errors.rrd.
    Its position_error_m is after that of the positions, its rotation_error_rad after that of the rotations.

    Returns:
        The files.

    Raises:
        PipelineError: the folder cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PipelineError(f"cannot make the folder {out}: {error.strerror}") from error
    texts = {
        "reference.tum": tum_lines(ours.times_ns, ours.reference),
        "estimate.tum": tum_lines(ours.times_ns, ours.estimate),
        ERRORS: _table(result, ours),
    }
    for one in others:
        texts[f"estimate.{one.name.replace(' ', '_')}.tum"] = tum_lines(one.times_ns, one.estimate)
    for name, text in texts.items():
        write_text(out / name, text)
    for name, picture in _pictures(result, ours, others).items():
        with atomic_path(out / name) as partial:
            partial.write_bytes(picture)
    write_error_rrd(out / "errors.rrd", [ours, *others])
    return [out / name for name in (*texts, "error.png", "path.png", "errors.rrd")]


def _table(result: SlamResult, ours: ComparedTrajectory) -> str:
    rows = zip(
        np.flatnonzero(np.isin(result.times_ns, ours.times_ns)).tolist(),
        ours.times_ns.tolist(),
        ours.position_errors_m.tolist(),
        rotation_errors_rad(ours.estimate, ours.reference).tolist(),
        strict=True,
    )
    std_m = np.sqrt(np.trace(result.covariance[:, :3, :3], axis1=1, axis2=2))
    lines = [
        f"{frame},{seconds_text(time_ns)},{position:.9f},{rotation:.9f},{std_m[frame]:.9f},{result.lost[frame]:d}"
        for frame, time_ns, position, rotation in rows
    ]
    return "\n".join([HEADER, *lines]) + "\n"


def _pictures(
    result: SlamResult, ours: ComparedTrajectory, others: Sequence[ComparedTrajectory]
) -> Mapping[str, bytes]:
    start_ns = int(ours.times_ns[0])
    time_s = (ours.times_ns - start_ns) / 1e9
    series = {ours.name: 100 * ours.position_errors_m}
    for one in others:
        series[one.name] = np.interp(
            ours.times_ns, one.times_ns, 100 * one.position_errors_m, left=np.nan, right=np.nan
        )
    lost = (result.times_ns[result.lost] - start_ns) / 1e9
    seen = {"reference": ours.reference, **{one.name: one.aligned for one in (ours, *others)}}
    return {
        "error.png": charts.lines(time_s, series, "time, s", "position error, cm", marked=lost),
        "path.png": charts.paths({name: poses[:, :3, 3] for name, poses in seen.items()}),
    }
