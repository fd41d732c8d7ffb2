"""The stage `room`: what the camera saw, fused along the trajectory."""

from __future__ import annotations

import itertools

import numpy as np

from pipeline.room import RoomView, view_room
from pipeline.session import Session
from slam.result import SlamResult


def room_stage(session: Session, trajectory: SlamResult) -> RoomView:
    """The room as seen along a committed trajectory."""

    def compute() -> RoomView:
        with session.common.progress("room", "frames") as progress:
            return view_room(session.recording, session.recording.intrinsics, trajectory.mean, progress)

    return session.stage("room", RoomView.load, compute, {}, {"slam": session.run.fingerprint("slam")})


def view_stage(session: Session, frame: int) -> RoomView:
    """What one frame saw, for runs that need no trajectory: the reference is that frame's camera."""

    def compute() -> RoomView:
        seen = itertools.islice(session.recording, frame, frame + 1)
        return view_room(seen, session.recording.intrinsics, np.eye(4)[None])

    return session.stage("room", RoomView.load, compute, {}, {"frame": str(frame)})
