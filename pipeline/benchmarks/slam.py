"""Tracking errors of `bench slam`: ours and the peers', on the same arrays in the same run.

Peers are tuned: on synthetic rows each runs with the setting that does best in rooms of other seeds, on
real rows with the one that does best on the recording itself, which favours them. Ours has one setting.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.benchmarks.slam_cases import Case, Row
from pipeline.evaluation.trajectory_errors import (
    coverage,
    largest_squared_distance,
    squared_distances,
    trajectory_errors,
)
from pipeline.logs import log
from pipeline.peers.registry import Track, settings_of
from pipeline.progress import Report
from pipeline.timing import processor_clock, timed
from recordings.errors import RecordingError
from shapes.geometry.pose_sets import within_reach
from slam.config import SlamConfig
from slam.result import SlamResult
from slam.tracking import track

TUNING_ROOMS = 2
FIRST_TUNING_ROOM = 5_000
LOST_M = np.inf
NEAR_M = 0.02
"""What a user is not misled by."""
MODE_REACH = 0.05, 0.05
"""Metres and radians from the truth within which a path stays that is the true mode's."""
Errors = dict[str, float]


def slam_rows(
    rows: Sequence[Row], peers: Sequence[str], rooms: int, seed: int, report: Report
) -> Iterator[dict[str, Any]]:
    """The table, a row as soon as it is measured: its runs, or why it was skipped.

    Args:
        rows: real ones first.
        peers: names of `pipeline.peers.registry`.
        rooms: cases of each synthetic row.
        seed: the first room's number; a row's cases differ from those that peers were tuned on.
        report: is told how many of how many cases are done.
    """
    total = sum(1 if row.real else rooms for row in rows)
    done = 0
    for row in rows:
        numbers = [0] if row.real else [seed * 10_000 + room for room in range(rooms)]
        try:
            tuned = {} if row.real else {name: _tuned(name, row) for name in peers}
            runs: dict[str, list[Errors]] = {}
            for number in numbers:
                case = row.case(number)
                for name, config in row.configs.items():
                    runs.setdefault(name, []).append(_ours(row, case, config, number))
                for name in peers:
                    settings = settings_of(name) if row.real else tuned[name]
                    runs.setdefault(name, []).append(_best(row, case, settings))
                done += 1
                report(done, total)
            yield {"row": row.name, "unit": _unit(row), **_figures(runs)}
        except RecordingError as error:
            done += len(numbers)
            yield {"row": row.name, "skipped": str(error)}


def _ours(row: Row, case: Case, config: SlamConfig, number: int) -> Errors:
    marks_s: list[float] = []
    with timed() as timing:
        result = track(
            jax.random.key(number),
            case.frames,
            case.intrinsics,
            config,
            lambda _: marks_s.append(processor_clock()),
        )
    steps_s = np.diff(marks_s)  # their median, for kernels are loaded in some
    truth = squared_distances(result.mean, result.covariance, case.poses)[1:]
    return {
        **_errors(row, case, result.mean),
        "frames_per_second": len(case.frames) / timing.seconds,
        "processor_s": timing.processor_s,
        "processor_ms_a_frame": 1e3 * float(np.median(steps_s)),
        "compile_s": timing.compile_s,
        "lost_frames": int(result.lost.sum()),
        "coverage_95": coverage(truth, float(result.degrees_of_freedom))[0.95],
        "told": _told(result, case),
        "modes_hold_truth": float(_holds_truth(result, case)),
    }


def _told(result: SlamResult, case: Case) -> float:
    """Share of frames, the first aside, whose position is near the truth, told as lost, or told to 95%."""
    away = np.linalg.norm(result.mean[1:, :3, 3] - case.poses[1:, :3, 3], axis=1)
    turned = np.swapaxes(result.mean[1:, :3, :3], 1, 2)
    shift = (turned @ (case.poses[1:, :3, 3] - result.mean[1:, :3, 3])[..., None])[..., 0]
    spread = result.covariance[1:, :3, :3] + 1e-12 * np.eye(3)
    squared = (shift * np.linalg.solve(spread, shift[..., None])[..., 0]).sum(axis=1)
    edge = largest_squared_distance(0.95, float(result.degrees_of_freedom), dimensions=3)
    return float(((away < NEAR_M) | result.lost[1:] | (squared <= edge)).mean())


def _holds_truth(result: SlamResult, case: Case) -> bool:
    """Whether the path of some particle stays by the truth: a symmetric mode that was kept."""
    near = within_reach(case.poses, result.trajectories, *MODE_REACH)
    return bool(near.all(axis=1).any())


def _tuned(name: str, row: Row) -> Mapping[str, Track]:
    """The one setting of a peer with the least median error in the tuning rooms."""
    cases = [row.case(FIRST_TUNING_ROOM + room) for room in range(TUNING_ROOMS)]
    medians = {
        setting: float(np.median([_peer(row, case, run)["error"] for case in cases]))
        for setting, run in settings_of(name).items()
    }
    best = min(medians, key=lambda setting: medians[setting])
    return {best: settings_of(name)[best]}


def _best(row: Row, case: Case, settings: Mapping[str, Track]) -> Errors:
    return min((_peer(row, case, run) for run in settings.values()), key=lambda errors: errors["error"])


def _peer(row: Row, case: Case, run: Track) -> Errors:
    """Its errors; one that raises, or leaves the numbers, is lost."""
    try:
        poses = run(case.frames, case.intrinsics)
    except Exception as raised:
        log.warning("%s: a peer failed and is told as lost: %s: %s", row.name, type(raised).__name__, raised)
        return {"error": LOST_M, "rotation_deg": LOST_M}
    if not np.isfinite(poses).all():
        return {"error": LOST_M, "rotation_deg": LOST_M}
    return _errors(row, case, poses)


def _errors(row: Row, case: Case, poses: NDArray[np.float64]) -> Errors:
    """`error` in metres (synthetic: from the first pose, real: aligned), and rotation from the first pose."""
    turned = np.swapaxes(poses[:, :3, :3], 1, 2) @ case.poses[:, :3, :3]
    rotation = float(np.degrees(np.sqrt((Rotation.from_matrix(turned).magnitude() ** 2).mean())))
    errors = trajectory_errors(poses, case.poses)
    if row.judged_by == "object":
        assert case.object_m is not None
        place = np.append(case.object_m, 1.0)
        placed = (poses @ np.linalg.inv(case.poses) @ place)[:, :3]
        return {
            "error": float(np.median(np.linalg.norm(placed - case.object_m, axis=1))),
            "rotation_deg": rotation,
        }
    if row.judged_by == "end":
        return {
            "error": float(np.linalg.norm(poses[-1, :3, 3] - case.poses[-1, :3, 3])),
            "rotation_deg": rotation,
        }
    return {"error": errors.ate_m if row.real else errors.ate_first_pose_m, "rotation_deg": rotation}


def _unit(row: Row) -> str:
    if row.judged_by == "object":
        return "mm of the object's place"
    if row.judged_by == "end":
        return "cm at the end"
    return "cm aligned" if row.real else "cm from the first pose"


def _figures(runs: Mapping[str, Sequence[Errors]]) -> dict[str, Any]:
    return {"runs": len(next(iter(runs.values()))), "trackers": {k: _summary(v) for k, v in runs.items()}}


def _summary(runs: Sequence[Errors]) -> dict[str, Any]:
    """Median, mean, least and most of each figure in metres, degrees, frames a second; lost runs counted."""
    lost = sum(not np.isfinite(run["error"]) for run in runs)
    summary: dict[str, Any] = {"lost_runs": lost}
    for figure in runs[0]:
        values = [run[figure] for run in runs if np.isfinite(run[figure])]
        if values:
            spread = {
                "median": np.median(values),
                "mean": np.mean(values),
                "least": min(values),
                "most": max(values),
            }
            summary[figure] = {name: float(value) for name, value in spread.items()}
    return summary
