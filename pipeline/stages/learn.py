"""The stage `learn`: what the object in the recording looks like, voxel by voxel."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.session import Session
from pipeline.stages.slam import slam_stage
from recordings.poses.recorded import recorded_trajectory
from shapes.learning.config import LearnConfig
from shapes.learning.distillation import learn_shape
from shapes.prior import ShapePrior
from slam.result import SlamResult


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedFrames:
    """Where the camera was, as far as learning needs it.

    Attributes:
        times_ns: (T,) stamps of the frames to use.
        trajectories: (K, T, 4, 4) reference_from_camera.
        log_weights: (K,) normalised.
        origin: hash of what they were made from.
    """

    times_ns: NDArray[np.int64]
    trajectories: NDArray[np.float64]
    log_weights: NDArray[np.float64]
    origin: str


def learn_stage(
    session: Session, name: str, options: Mapping[str, Any] | None = None, *, recorded_poses: bool = False
) -> ShapePrior:
    """The shape of the object in the session's recording.

    Args:
        session: the recording and the run folder.
        name: of the shape.
        options: what the command's own options say, by key of `LearnConfig`.
        recorded_poses: take the recording's own poses instead of running slam.

    Raises:
        PipelineError: there is no object to learn, or there are no recorded poses.
    """
    config = session.common.settings.section("learn", LearnConfig, options)
    posed = _recorded(session) if recorded_poses else _tracked(session)
    used = config if recorded_poses else config.for_tracked_poses

    def compute() -> ShapePrior:
        stamps = set(posed.times_ns.tolist())
        with session.common.progress(f"learn {name}", "trajectories") as progress:
            try:
                return learn_shape(
                    session.key("learn"),
                    (frame for frame in session.recording if frame.time_ns in stamps),
                    session.recording.intrinsics,
                    posed.trajectories,
                    posed.log_weights,
                    used,
                    progress,
                )
            except ValueError as error:
                raise PipelineError(f"{session.source.path}: {error}") from error

    inputs = {"poses": posed.origin}
    return session.stage(f"learn/{name}", ShapePrior.load, compute, {"learn": config}, inputs)


def tracked_frames(result: SlamResult, origin: str = "") -> PosedFrames:
    """The poses of the frames that slam did not lose.

    Raises:
        PipelineError: it lost all of them.
    """
    found = ~result.lost
    if not found.any():
        raise PipelineError("slam lost every frame, there are no poses to learn from")
    return PosedFrames(
        times_ns=result.times_ns[found],
        trajectories=result.trajectories[:, found],
        log_weights=result.log_weights,
        origin=origin,
    )


def _tracked(session: Session) -> PosedFrames:
    result = slam_stage(session)
    try:
        return tracked_frames(result, session.run.fingerprint("slam"))
    except PipelineError as error:
        raise PipelineError(f"{session.source.path}: {error}") from error


def _recorded(session: Session) -> PosedFrames:
    """The poses that the recording brings."""
    options = session.source.read_options(session.common.settings)
    trajectory = recorded_trajectory(session.source.path, options)
    if trajectory is None:
        raise PipelineError(f"{session.source.path} has no recorded poses; leave out --poses recorded")
    poses = np.linalg.inv(trajectory.reference_from_camera[0]) @ trajectory.reference_from_camera
    digest = hashlib.sha256(trajectory.times_ns.tobytes() + poses.tobytes()).hexdigest()
    return PosedFrames(
        times_ns=trajectory.times_ns, trajectories=poses[None], log_weights=np.zeros(1), origin=digest
    )
