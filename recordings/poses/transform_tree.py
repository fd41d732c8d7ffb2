"""The tree of frames that transforms span, and the way from a frame up to its root."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.cameras.matching import frame_name
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import OdometryMessage, TransformMessage
from recordings.poses.track import Track
from recordings.stamps import is_of_this_age


class TransformTree:
    """Frames by name, each with the track of its transform to its parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Track]] = {}

    def add(self, transform: TransformMessage, time_ns: int, *, is_mounting: bool) -> None:
        """Take in a transform, of two frames fixed to each other or not; a frame's first parent counts.

        One at a time that damage made is passed over.
        """
        if not is_of_this_age(time_ns):
            return
        parent, track = self._parents.setdefault(
            frame_name(transform.child), (frame_name(transform.parent), Track(is_mounting=is_mounting))
        )
        if parent == frame_name(transform.parent):
            track.add(time_ns, transform.parent_from_child)

    def has_parent(self, frame: str) -> bool:
        """Whether a transform from this frame to another is known."""
        return frame_name(frame) in self._parents

    def is_fixed_frame(self, frame: str) -> bool:
        """Whether a frame is one in which others move and that hangs below none, such as map or odom."""
        tracks = [track for parent, track in self._parents.values() if parent == frame_name(frame)]
        return not self.has_parent(frame) and any(track.moves for track in tracks)

    def way_up(self, frame: str) -> list[Track]:
        """The tracks from a frame to its root; empty where the frame has no parent."""
        way: list[Track] = []
        seen = {frame := frame_name(frame)}
        while frame in self._parents:
            parent, track = self._parents[frame]
            if parent in seen:
                break
            way.append(track)
            seen.add(parent)
            frame = parent
        return way

    def mounting(self, target: str, source: str) -> NDArray[np.float64] | None:
        """target_from_source (4, 4) of two frames that are fixed to each other for good, else None."""
        target_up, source_up = self._mounted_above(target), self._mounted_above(source)
        common = next((frame for frame in source_up if frame in target_up), None)
        if common is None:
            return None
        return np.linalg.inv(target_up[common]) @ source_up[common]

    def _mounted_above(self, frame: str) -> dict[str, NDArray[np.float64]]:
        """Every frame that a frame is mounted below, itself first, with its transform (4, 4) from there."""
        above, frame_from_start = {(frame := frame_name(frame)): np.eye(4)}, np.eye(4)
        while frame in self._parents:
            parent, track = self._parents[frame]
            parent_from_child = track.at(0) if track.is_mounting else None
            if parent in above or parent_from_child is None:
                break
            frame_from_start = parent_from_child @ frame_from_start
            above[parent] = frame_from_start
            frame = parent
        return above


def recorded_transforms(decoded: DecodedBag, *, mountings_only: bool = False) -> TransformTree:
    """The transforms of a recording; odometry counts as one where nothing else places its body.

    Args:
        decoded: the recording.
        mountings_only: read only the topics of transforms that never change.
    """
    tree = TransformTree()
    odometry: list[tuple[int, OdometryMessage]] = []
    for topic in decoded.topic_names:
        # ROS says in the topic's name alone which transforms hold for good.
        is_mounting = topic.endswith("static")
        if mountings_only and not is_mounting:
            continue
        if isinstance(decoded.first(topic), tuple | OdometryMessage):
            for log_time_ns, message in decoded.messages({topic}):
                if isinstance(message, OdometryMessage):
                    odometry.append((log_time_ns, message))
                elif isinstance(message, tuple):
                    for transform in message:
                        tree.add(transform, transform.stamp_ns or log_time_ns, is_mounting=is_mounting)
    known = {message.transform.child for _, message in odometry if tree.has_parent(message.transform.child)}
    for log_time_ns, message in odometry:
        if message.transform.child not in known:
            tree.add(message.transform, message.transform.stamp_ns or log_time_ns, is_mounting=False)
    return tree


def composed(way: list[Track], time_ns: int, *, holds: bool = False) -> NDArray[np.float64] | None:
    """The transform (4, 4) from the first frame of a way to the last at a time, None where a link lacks.

    Where one link moves, those that never do hold at all times: robots publish their fixed joints on /tf,
    some once. Where none moves, /tf may have fallen silent, and says nothing on times far from its own.

    Args:
        way: from `way_up`.
        time_ns: the time.
        holds: whether links hold at all times where none moves, too.
    """
    holds = holds or any(track.moves for track in way if not track.is_mounting)
    root_from_frame = np.eye(4)
    for track in way:
        parent_from_child = track.at(time_ns, holds=holds)
        if parent_from_child is None:
            return None
        root_from_frame = parent_from_child @ root_from_frame
    return root_from_frame
