"""The stage `room`: what the camera saw, fused along the trajectory."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from pipeline.room import RoomView, view_room
from pipeline.run_folder import Committed
from pipeline.session import Session

if TYPE_CHECKING:
    from scene.result import SceneResult
    from slam.result import SlamResult

SOURCES = ("pipeline.stages.room", "pipeline.room")


def room_stage(session: Session, trajectory: Committed[SlamResult]) -> Committed[RoomView]:
    """The room as seen along a committed trajectory."""

    def compute() -> RoomView:
        poses = trajectory.value.mean
        with session.common.progress("room", "frames") as progress:
            return view_room(session.recording, session.recording.intrinsics, poses, progress)

    return session.stage("room", RoomView.load, compute, {}, uses=[trajectory], sources=SOURCES)


def view_stage(session: Session, scene: Committed[SceneResult]) -> Committed[RoomView]:
    """What the first parsed frame saw, for runs that need no trajectory: the reference is its camera."""

    def compute() -> RoomView:
        frame = int(scene.value.frames[0])
        seen = itertools.islice(session.recording, frame, frame + 1)
        return view_room(seen, session.recording.intrinsics, np.eye(4)[None])

    return session.stage("room", RoomView.load, compute, {}, uses=[scene], sources=SOURCES)
