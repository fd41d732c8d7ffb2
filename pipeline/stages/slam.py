"""The stage `slam`: where the camera was, in every frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.errors import PipelineError
from pipeline.session import Session
from pipeline.stages.room import room_stage
from slam.config import SlamConfig
from slam.result import SlamResult
from slam.tracking import track


def slam_stage(session: Session, options: Mapping[str, Any] | None = None) -> SlamResult:
    """The camera's trajectory in the session's recording.

    Args:
        session: the recording and the run folder.
        options: what the command's own options say, by key of `SlamConfig`.

    Raises:
        PipelineError: the recording has no depth frame with a return.
    """
    config = session.common.settings.section("slam", SlamConfig, options)

    def compute() -> SlamResult:
        total = len(session.recording)
        with session.common.progress("slam", "frames") as progress:
            done = 0

            def on_frame(_: object) -> None:
                nonlocal done
                done += 1
                progress(done, total)

            try:
                return track(
                    session.key("slam"), session.recording, session.recording.intrinsics, config, on_frame
                )
            except ValueError as error:
                raise PipelineError(f"{session.source.path}: {error}") from error

    trajectory = session.stage("slam", SlamResult.load, compute, {"slam": config})
    room_stage(session, trajectory)
    return trajectory
