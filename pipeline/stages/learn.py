"""The stage `learn`: what the object in the recording looks like, voxel by voxel."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.checkpoints import CheckpointKeeper
from pipeline.errors import PipelineError
from pipeline.publishing.trajectory_files import seconds_text
from pipeline.run_folder import Committed
from pipeline.session import Session
from pipeline.stages.slam import slam_stage
from shapes.geometry.poses import matrices_of
from shapes.learning.config import LearnConfig
from shapes.learning.region import place_of_pixel

if TYPE_CHECKING:
    from recordings.options import ReadOptions
    from recordings.types import Frame, Trajectory
    from shapes.prior import ShapePrior
    from slam.result import SlamResult

SOURCES = ("pipeline.stages.learn", "shapes.learning.distillation", "recordings.poses.recorded")


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedFrames:
    """Where the camera was, as far as learning needs it.

    Attributes:
        times_ns: (T,) stamps of the frames to use.
        trajectories: (K, T, 4, 4) reference_from_camera.
        log_weights: (K,) normalised.
    """

    times_ns: NDArray[np.int64]
    trajectories: NDArray[np.float64]
    log_weights: NDArray[np.float64]


def learn_stage(
    session: Session, name: str, options: Mapping[str, Any] | None = None, *, recorded_poses: bool = False
) -> Committed[ShapePrior]:
    """The shape of the object in the session's recording.

    Args:
        session: the recording and the run folder.
        name: of the shape.
        options: what the command's own options say, by key of `LearnConfig`.
        recorded_poses: take the recording's own poses instead of running slam.

    Raises:
        PipelineError: there is no object to learn, or it is pointed at outside the images; there are no
            recorded poses, or the run holds a stage of other frames.
    """
    config = learn_config(session, options)
    config = config.with_noise(session.recording.sensor and session.recording.sensor.noise)
    if recorded_poses:
        session.begin(f"learn/{name}")
        poses = _recorded(session)
        return session.stage(
            f"learn/{name}",
            _load,
            lambda: _learn(session, name, _posed(poses), config),
            {"learn": config},
            {"poses": _hash(poses)},
            sources=SOURCES,
        )
    session.begin(f"learn/{name}", "slam", "sensor")
    trajectory = slam_stage(session)
    used = config.for_tracked_poses
    return session.stage(
        f"learn/{name}",
        _load,
        lambda: _learn(session, name, tracked_frames(trajectory.value), used),
        {"learn": config},
        uses=[trajectory],
        sources=SOURCES,
    )


def learn_config(session: Session, options: Mapping[str, Any] | None) -> LearnConfig:
    """The settings of learning, compared with the images before slam takes minutes.

    Raises:
        PipelineError: the pixel that is pointed at is outside the images.
    """
    config = session.common.settings.section("learn", LearnConfig, options)
    if config.pixel is not None:
        try:
            place_of_pixel(config.pixel, session.recording.intrinsics)
        except ValueError as error:
            raise PipelineError(f"learn.pixel: {error}") from error
    return config


def posed_frames(session: Session, *, recorded_poses: bool) -> PosedFrames:
    """The frames that learning may use: those that slam, run now where it was not, did not lose.

    Raises:
        PipelineError: it lost all of them, or there are no recorded poses.
    """
    return _posed(_recorded(session)) if recorded_poses else tracked_frames(slam_stage(session).value)


def tracked_frames(result: SlamResult) -> PosedFrames:
    """The poses of the frames that slam did not lose.

    Raises:
        PipelineError: it lost all of them.
    """
    found = ~result.lost
    if not found.any():
        raise PipelineError("slam lost every frame, there are no poses to learn from")
    return PosedFrames(
        times_ns=result.times_ns[found],
        trajectories=matrices_of(result.draws[:, found]),
        log_weights=result.log_weights,
    )


def used_frames(session: Session, posed: PosedFrames, config: LearnConfig) -> tuple[list[Frame], PosedFrames]:
    """The frames that are learned from, by increasing time, and where the camera was in them.

    A recording brings poses of frames that cannot be decoded, too: these are left out. It is said in which
    frame --box or --pixel is told, where that is not the recording's first.

    Raises:
        PipelineError: none can be decoded.
    """
    from shapes.learning.distillation import select_views

    stamps = set(posed.times_ns[select_views(len(posed.times_ns), config)].tolist())
    frames = [frame for frame in session.recording if frame.time_ns in stamps]
    if not frames:
        problems = session.recording.problems
        lost = f"; {problems[0]}" if problems else ""
        raise PipelineError(f"{session.source.path}: no frame that has a pose can be decoded{lost}")
    if config.box is not None:
        _warn_of_later_frame(session, "--box", int(posed.times_ns[0]))
    elif config.pixel is not None:
        _warn_of_later_frame(session, "--pixel", frames[0].time_ns)
    used = np.isin(posed.times_ns, [frame.time_ns for frame in frames])
    return frames, replace(posed, times_ns=posed.times_ns[used], trajectories=posed.trajectories[:, used])


def _warn_of_later_frame(session: Session, option: str, time_ns: int) -> None:
    """Say of which frame an option tells, where it is not the recording's first; numbered as slam does."""
    before = itertools.takewhile(lambda frame: frame.time_ns < time_ns, session.recording)
    if number := sum(1 for _ in before):
        session.warn(
            f"{option} is told in frame {number}, at {seconds_text(time_ns)} s: those before it are lost or "
            "have no pose; --preview shows the region in it"
        )


def _load(path: Path) -> ShapePrior:
    from shapes.prior import ShapePrior

    return ShapePrior.load(path)


def _learn(session: Session, name: str, posed: PosedFrames, config: LearnConfig) -> ShapePrior:
    from shapes.learning.checkpoint import LearnCheckpoint
    from shapes.learning.distillation import learn_shape

    assert session.run.checkpoint_path is not None  # while the stage is computed
    keeper = CheckpointKeeper(session.run.checkpoint_path)
    with session.common.progress(f"learn {name}", "trajectories") as progress:
        progress.phase("reading")
        session.look()
        frames, used = used_frames(session, posed, config)
        progress.phase("finding the object, compiling once")
        try:
            return learn_shape(
                session.key("learn"),
                frames,
                session.recording.intrinsics,
                used.trajectories,
                used.log_weights,
                config,
                progress,
                checkpoint=keeper.found(LearnCheckpoint.load),
                on_checkpoint=keeper.keep,
            )
        except ValueError as error:
            raise PipelineError(f"{session.source.path}: {error}") from error


def _recorded(session: Session) -> Trajectory:
    """The poses that the recording brings.

    Raises:
        PipelineError: it brings none, or the same one for all of its frames.
    """
    options = session.source.read_options(session.common.settings)
    trajectory = recorded_path(session.source.path, options)
    if trajectory is None:
        raise PipelineError(f"{session.source.path} has no recorded poses; leave out --poses recorded")
    if not trajectory.moves and len(list(itertools.islice(session.recording.stamps_ns(), 2))) > 1:
        raise PipelineError(
            f"{session.source.path}: by its recorded poses the camera never moved, as where only its "
            "mounting is recorded; without --poses recorded slam finds the camera"
        )
    return trajectory


def _hash(path: Trajectory) -> str:
    return hashlib.sha256(path.times_ns.tobytes() + path.reference_from_camera.tobytes()).hexdigest()


def recorded_path(recording: Path, options: ReadOptions) -> Trajectory | None:
    """The poses that a recording brings, in the camera of the first frame that has one; None without any."""
    from recordings.poses.recorded import recorded_trajectory

    trajectory = recorded_trajectory(recording, options)
    if trajectory is None:
        return None
    poses = trajectory.reference_from_camera
    return replace(trajectory, reference_from_camera=np.linalg.inv(poses[0]) @ poses)


def _posed(trajectory: Trajectory) -> PosedFrames:
    poses = trajectory.reference_from_camera
    return PosedFrames(times_ns=trajectory.times_ns, trajectories=poses[None], log_weights=np.zeros(1))
