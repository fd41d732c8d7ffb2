"""The stage `room`: what the camera saw, fused along the trajectory."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.room import RoomView, view_room
from pipeline.run_folder import Committed
from pipeline.session import Session
from recordings.poses.recorded import has_recorded_parent

if TYPE_CHECKING:
    from recordings.reading import McapRecording
    from scene.result import SceneResult
    from slam.result import SlamResult

SOURCES = ("pipeline.stages.room", "pipeline.room")


def room_stage(session: Session, trajectory: Committed[SlamResult]) -> Committed[RoomView]:
    """The room as seen along a committed trajectory."""

    def compute() -> RoomView:
        recording, poses, lost = session.recording, trajectory.value.mean, trajectory.value.lost
        with session.common.progress("room", "frames") as progress:

            def on_frame(done: int, total: int) -> None:
                progress(done, total)
                if done == total:
                    progress.phase("fusing the cloud")

            return view_room(
                recording, recording.intrinsics, poses, on_frame, lost=lost, **_camera_frame(recording)
            )

    return session.stage("room", RoomView.load, compute, {}, uses=[trajectory], sources=SOURCES)


def view_stage(session: Session, scene: Committed[SceneResult]) -> Committed[RoomView]:
    """What the first parsed frame saw, for runs that need no trajectory: the reference is its camera."""

    def compute() -> RoomView:
        recording, frame = session.recording, int(scene.value.frames[0])
        seen = itertools.islice(recording, frame, frame + 1)
        view = view_room(seen, recording.intrinsics, np.eye(4)[None], **_camera_frame(recording))
        return replace(view, frames=np.array([frame], np.int32))  # as the recording numbers it

    return session.stage("room", RoomView.load, compute, {}, uses=[scene], sources=SOURCES)


def _camera_frame(recording: McapRecording) -> dict[str, Any]:
    """The recording's own frame of the camera, so that what is published can be joined with it."""
    return {
        "frame_id": recording.frame_id,
        "frame_has_parent": has_recorded_parent(recording),
        "frame_from_camera": recording.frame_from_camera,
    }
