"""The tree of frames that transforms span, and the way from a frame up to its root."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.messages.types import TransformMessage
from recordings.poses.track import Track


class TransformTree:
    """Frames by name, each with the track of its transform to its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Track]] = {}

    def add(self, transform: TransformMessage, time_ns: int, *, is_mounting: bool) -> None:
        """Take in a transform, of two frames fixed to each other or not; a frame's first parent counts."""
        parent, track = self._parents.setdefault(
            _plain(transform.child), (_plain(transform.parent), Track(is_mounting=is_mounting))
        )
        if parent == _plain(transform.parent):
            track.add(time_ns, transform.parent_from_child)

    def has_parent(self, frame: str) -> bool:
        """Whether a transform from this frame to another is known."""
        return _plain(frame) in self._parents

    def way_up(self, frame: str) -> list[Track]:
        """The tracks from a frame to its root; empty where the frame has no parent."""
        way: list[Track] = []
        seen = {frame := _plain(frame)}
        while frame in self._parents:
            parent, track = self._parents[frame]
            if parent in seen:
                break
            way.append(track)
            seen.add(parent)
            frame = parent
        return way


def _plain(name: str) -> str:
    """A frame's name without the leading slash of ROS 1."""
    return name.removeprefix("/")


def composed(way: list[Track], time_ns: int) -> NDArray[np.float64] | None:
    """The transform (4, 4) from the first frame of a way to the last at a time, None where a link lacks."""
    root_from_frame = np.eye(4)
    for track in way:
        parent_from_child = track.at(time_ns)
        if parent_from_child is None:
            return None
        root_from_frame = parent_from_child @ root_from_frame
    return root_from_frame
