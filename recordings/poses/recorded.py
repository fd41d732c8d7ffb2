"""The recorded trajectory of the depth camera: for evaluation, and for `--poses recorded`."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recordings.cameras.matching import shared_namespace
from recordings.errors import RecordingError
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import PoseMessage
from recordings.options import ReadOptions
from recordings.poses.track import Track
from recordings.poses.transform_tree import composed, recorded_transforms
from recordings.reading import McapRecording, open_recording
from recordings.stamps import is_of_this_age
from recordings.types import Trajectory

PoseAt = Callable[[int], NDArray[np.float64] | None]

_DEFAULT_OPTIONS = ReadOptions()
_LEAST_POSES = 2
"""Of a topic that says where something was: a single pose is a goal, or where a robot set out."""

_log = logging.getLogger("voxscene.recordings")


def recorded_trajectory(path: Path, options: ReadOptions = _DEFAULT_OPTIONS) -> Trajectory | None:
    """The recorded poses of the depth camera at the stamps of its frames, or None without any.

    The reference frame is the root of the recorder's own frames, which for recordings that voxscene
    wrote is the world of their truth. Transforms are followed from the frame of the depth images up to
    the root; odometry counts as a transform where there is none; a topic of bare poses serves if the
    camera's frame leads nowhere, which is said in a warning. Frames without a pose near in time are left out.

    Raises:
        RecordingError: the recording cannot be read, several pose topics could be meant, or none of the poses
            is near a frame in time.
    """
    recording = open_recording(path, options)
    pose_at = _camera_pose(recording, holds=False)
    if pose_at is None:
        return None
    stamped = [(stamp, pose_at(stamp)) for stamp in recording.stamps_ns()]
    found = [(stamp, pose) for stamp, pose in stamped if pose is not None]
    if stamped and not found:
        raise RecordingError(
            f"{path} records poses of the camera, but none near the stamp of a frame: is their clock "
            "another, or was one sent but once?"
        )
    if not found:
        return None
    times, poses = zip(*found, strict=True)
    return Trajectory(
        times_ns=np.array(times, np.int64),
        reference_from_camera=np.stack(poses) @ recording.frame_from_camera,
    )


def recorded_pose(recording: McapRecording, time_ns: int) -> NDArray[np.float64] | None:
    """Where the depth camera was at a time (4, 4), in the frame of `recorded_trajectory`; None if unknown.

    Of a camera that is told to be at one place alone it is that place at all times.

    Raises:
        RecordingError: several pose topics could be meant.
    """
    pose_at = _camera_pose(recording, holds=True)
    pose = None if pose_at is None else pose_at(time_ns)
    return None if pose is None else pose @ recording.frame_from_camera


def has_recorded_parent(recording: McapRecording) -> bool:
    """Whether a transform of the recording leads on from the frame of its depth images."""
    return recorded_transforms(recording.decoded).has_parent(recording.frame_id)


def _camera_pose(recording: McapRecording, *, holds: bool) -> PoseAt | None:
    """Where the frame of the depth images was at a time; `holds` as of `composed`."""
    way = recorded_transforms(recording.decoded).way_up(recording.frame_id)
    if any(not track.is_mounting for track in way):
        return partial(composed, way, holds=holds)
    topic = _nearest_pose_topic(recording.decoded, recording.depth_topic)
    if topic is None:
        return None
    _log.warning(
        "%s: the poses of %s, which do not name what they are of, are taken for the camera's",
        recording.decoded.bag.path,
        topic,
    )
    return partial(_pose_track(recording.decoded, topic).at, holds=holds)


def _nearest_pose_topic(decoded: DecodedBag, depth_topic: str) -> str | None:
    topics = [topic for topic in decoded.topic_names if _holds_poses(decoded, topic)]
    if not topics:
        return None
    shared = max(shared_namespace(depth_topic, topic) for topic in topics)
    nearest = [topic for topic in topics if shared_namespace(depth_topic, topic) == shared]
    if len(nearest) > 1:
        raise RecordingError(
            f"{decoded.bag.path} has {len(nearest)} pose topics that could be the camera's: "
            f"{', '.join(nearest)}; record only one, or transforms to the camera's frame"
        )
    return nearest[0]


def _holds_poses(decoded: DecodedBag, topic: str) -> bool:
    poses = (message for _, message in decoded.messages({topic}) if isinstance(message, PoseMessage))
    return (
        isinstance(decoded.first(topic), PoseMessage)
        and len(list(islice(poses, _LEAST_POSES))) == _LEAST_POSES
    )


def _pose_track(decoded: DecodedBag, topic: str) -> Track:
    track = Track()
    for log_time_ns, message in decoded.messages({topic}):
        if isinstance(message, PoseMessage) and is_of_this_age(message.stamp_ns or log_time_ns):
            track.add(message.stamp_ns or log_time_ns, message.frame_from_body)
    return track
