"""A run's trajectory against a reference, and peers on the same frames."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.atomic import RECORDINGS
from pipeline.errors import PipelineError
from pipeline.evaluation.trajectory_errors import (
    TrajectoryErrors,
    coverage,
    level_of,
    matched,
    rigid_alignment,
    squared_distances,
    trajectory_errors,
)
from pipeline.logs import log
from pipeline.peers.registry import best_of
from recordings.mcap_files.sources import ZSTD_SUFFIXES
from recordings.options import ReadOptions
from recordings.poses.recorded import recorded_trajectory
from recordings.poses.rigid import orthonormalised
from recordings.reading import open_recording
from recordings.settings import TEXT
from recordings.types import CameraIntrinsics, Frame, Trajectory
from slam.result import SlamResult

TUM_COLUMNS = 8
SECOND_NS = 1_000_000_000
LATEST_S = 1 << 32
"""Stamps beyond the year 2106 are not of seconds."""


def reference_trajectory(path: Path, options: ReadOptions) -> Trajectory:
    """The reference in a TUM file, or the recorded poses of a recording.

    Raises:
        PipelineError: there are no poses in it.
    """
    if is_trajectory_file(path):
        return _read_tum(path)
    trajectory = recorded_trajectory(path, options)
    if trajectory is None:
        raise PipelineError(f"{path} has no recorded poses; give a TUM file instead")
    if len(trajectory) > 1 and not trajectory.moves:
        log.warning(
            "%s: by its recorded poses the camera never moved, as where only its mounting is recorded; "
            "is that right? else give a TUM file instead",
            path,
        )
    return trajectory


def is_trajectory_file(path: Path) -> bool:
    """Whether a file is taken for a TUM trajectory, and not for a recording, by its name or first bytes."""
    if not path.is_file() or path.suffix in (".mcap", *ZSTD_SUFFIXES):
        return False
    with path.open("rb") as file:
        return not file.read(16).startswith(RECORDINGS)


def _read_tum(path: Path) -> Trajectory:
    from scipy.spatial.transform import Rotation

    try:
        with warnings.catch_warnings(action="ignore"):  # of no lines, told below
            rows = np.loadtxt(path, ndmin=2, comments="#", encoding=TEXT)
            stamps = np.loadtxt(path, dtype=str, usecols=0, ndmin=1, comments="#", encoding=TEXT)
    except (OSError, ValueError) as error:
        raise PipelineError(f"{path} is not a TUM trajectory: {error}") from error
    if rows.size == 0 or rows.shape[1] != TUM_COLUMNS:
        raise PipelineError(f"{path} is not a TUM trajectory: each line needs `stamp x y z qx qy qz qw`")
    if not (finite := np.isfinite(rows).all(axis=1)).all():
        raise PipelineError(f"{path} is not a TUM trajectory: pose {finite.argmin() + 1} is not finite")
    if (late := np.abs(rows[:, 0]) >= LATEST_S).any():
        raise PipelineError(f"{path} is not a TUM trajectory: {stamps[late][0]} is no time in seconds")
    if (np.linalg.norm(rows[:, 4:], axis=1) == 0).any():
        raise PipelineError(f"{path}: a quaternion is zero")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    times_ns = [round(Decimal(stamp) * SECOND_NS) for stamp in stamps.tolist()]  # a float has too few digits
    return Trajectory(times_ns=np.array(times_ns, np.int64), reference_from_camera=poses)


def slam_errors(result: SlamResult, reference: Trajectory) -> dict[str, Any]:
    """Errors and coverage of a run, as they are printed; where frames are lost, errors of the others, too.

    Raises:
        PipelineError: fewer than two frames have a reference pose.
    """
    frames, poses = compared(result.times_ns, reference)
    errors = trajectory_errors(result.mean[frames], poses)
    squared = _squared_from_first(result, frames, poses)
    document = {
        **asdict(errors),
        "lost_frames": int(result.lost.sum()),
        "coverage": {
            f"{level:g}": share
            for level, share in coverage(squared, float(result.degrees_of_freedom)).items()
        },
    }
    found = ~result.lost[frames]
    if 1 < found.sum() < len(found):
        document["found"] = asdict(trajectory_errors(result.mean[frames[found]], poses[found]))
    return document


def levels_of_truth(result: SlamResult, reference: Trajectory) -> NDArray[np.float64]:
    """Level (n,) of the region told of each frame's pose at whose edge the reference lies, from the first on.

    Raises:
        PipelineError: fewer than two frames have a reference pose.
    """
    squared = _squared_from_first(result, *compared(result.times_ns, reference))
    return np.array([level_of(float(one), float(result.degrees_of_freedom)) for one in squared])


def _squared_from_first(
    result: SlamResult, frames: NDArray[np.int_], poses: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Mahalanobis distances squared (n - 1,) of reference poses (n, 4, 4), the first taken as found."""
    from_first = np.linalg.inv(result.mean[frames[0]]) @ result.mean[frames]
    truth = np.linalg.inv(poses[0]) @ poses
    return squared_distances(from_first, result.covariance[frames], truth)[1:]


def compared(
    times_ns: NDArray[np.int64], reference: Trajectory
) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
    """Frames (n,) that have a reference pose, and those poses (n, 4, 4).

    Raises:
        PipelineError: they are fewer than two.
    """
    if len(times_ns) < 2:
        raise PipelineError("the path is of one frame: there is no motion to compare")
    frames, nearest = matched(times_ns, reference)
    if len(frames) < 2:
        raise PipelineError("fewer than two frames have a reference pose within 20 ms; do the stamps agree?")
    return frames, orthonormalised(reference.reference_from_camera[nearest])


@dataclass(frozen=True, kw_only=True, eq=False)
class ComparedTrajectory:
    """An estimated trajectory beside the reference, at the frames that have both.

    Attributes:
        name: of who estimated it, with its setting.
        times_ns: (n,) stamps.
        estimate: (n, 4, 4) in the estimate's own frame of reference.
        reference: (n, 4, 4) in the reference's.
    """

    name: str
    times_ns: NDArray[np.int64]
    estimate: NDArray[np.float64]
    reference: NDArray[np.float64]

    @property
    def errors(self) -> TrajectoryErrors:
        """How far the estimate is from the reference."""
        return trajectory_errors(self.estimate, self.reference)

    @property
    def aligned(self) -> NDArray[np.float64]:
        """The estimate (n, 4, 4) moved rigidly so that its positions come closest to the reference's."""
        return rigid_alignment(self.estimate[:, :3, 3], self.reference[:, :3, 3]) @ self.estimate

    @property
    def position_errors_m(self) -> NDArray[np.float64]:
        """Distances (n,) of the aligned positions from the reference's."""
        return np.linalg.norm(self.aligned[:, :3, 3] - self.reference[:, :3, 3], axis=1)


def compared_run(result: SlamResult, reference: Trajectory) -> ComparedTrajectory:
    """A run's trajectory beside a reference.

    Raises:
        PipelineError: fewer than two frames have a reference pose.
    """
    frames, poses = compared(result.times_ns, reference)
    return ComparedTrajectory(
        name="voxscene", times_ns=result.times_ns[frames], estimate=result.mean[frames], reference=poses
    )


def compared_file(path: Path, reference: Trajectory) -> ComparedTrajectory:
    """A TUM file of somebody else beside a reference.

    Raises:
        PipelineError: it is no TUM file, or fewer than two of its poses have a reference.
    """
    estimate = _read_tum(path)
    frames, poses = compared(estimate.times_ns, reference)
    return ComparedTrajectory(
        name=path.stem,
        times_ns=estimate.times_ns[frames],
        estimate=estimate.reference_from_camera[frames],
        reference=poses,
    )


def peer_runs(
    names: Sequence[str],
    frames: Iterable[Frame],
    intrinsics: CameraIntrinsics,
    ours: ComparedTrajectory,
    on_peer: Callable[[int, int], None],
) -> dict[str, ComparedTrajectory | str]:
    """Peers on the frames that were compared, each with its best setting; why, where it failed."""
    found: dict[str, ComparedTrajectory | str] = {}
    for index, name in enumerate(names):
        on_peer(index, len(names))
        run = best_of(
            name, frames, intrinsics, lambda estimate: trajectory_errors(estimate, ours.reference).ate_m
        )
        if run.poses is None:
            found[name] = run.problem
        else:
            found[name] = replace(ours, name=run.name, estimate=run.poses)
    on_peer(len(names), len(names))
    return found


class FramesAt:
    """The frames of a recording with some stamps, read anew at each iteration: an hour has no room in memory.

    Attributes:
        intrinsics: their camera.
    """

    def __init__(self, path: Path, options: ReadOptions, times_ns: NDArray[np.int64]) -> None:
        """Those of `path` with stamps (n,)."""
        self._recording = open_recording(path, options)
        self._wanted = set(times_ns.tolist())
        self.intrinsics: CameraIntrinsics = self._recording.intrinsics

    def __iter__(self) -> Iterator[Frame]:
        """In the order of time."""
        return (frame for frame in self._recording if frame.time_ns in self._wanted)

    def __len__(self) -> int:
        """How many there are, pixels not decoded."""
        return sum(stamp in self._wanted for stamp in self._recording.stamps_ns())
