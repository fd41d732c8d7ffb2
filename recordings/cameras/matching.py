"""The camera topic that belongs to an image topic: by frame_id, else by the nearest namespace."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from recordings.cameras.pinhole import UnusableCamera
from recordings.messages.types import CameraMessage

_TRANSPORTS = {"compressed", "compressedDepth", "theora", "zstd"}
_RECTIFIED = {"rect", "rectified"}


def namespace(topic: str) -> tuple[str, ...]:
    """The parts of a topic's name above its last, transports not counted.

    `/camera/depth/image_raw/compressedDepth` and `/camera/depth/camera_info` share ("camera", "depth").
    """
    parts = [part for part in topic.split("/") if part]
    if parts and parts[-1] in _TRANSPORTS:
        parts.pop()
    return tuple(parts[:-1])


def base_topic(topic: str) -> str:
    """The topic whose images a transport topic carries, by image_transport's names; else the topic itself."""
    base, _, last = topic.rpartition("/")
    return base if last in _TRANSPORTS else topic


def is_rectified(topic: str) -> bool:
    """Whether the images of a topic are rectified, which ROS says in the topic's name alone (image_proc).

    It is a word of the last part: image_rect, image_rect_raw, rectified; not unrectified, direct, corrected.
    """
    parts = [part for part in topic.split("/") if part and part not in _TRANSPORTS]
    return bool(parts) and not _RECTIFIED.isdisjoint(parts[-1].lower().replace("-", "_").split("_"))


def matching_camera(
    image_topic: str, frame_id: str, size: tuple[int, int], cameras: Mapping[str, CameraMessage]
) -> tuple[str, CameraMessage] | None:
    """The camera topic of an image topic and its message, or None without any camera.

    A camera of another frame than the images' counts only where it stands beside them or above, as
    `/camera/camera_info` does: elsewhere it is another camera's.

    Args:
        image_topic: the images' topic.
        frame_id: the frame that the images say they were taken in.
        size: their width and height, which decides between equally near cameras.
        cameras: a usable message of each camera topic.

    Raises:
        UnusableCamera: every camera is another's, or several with different calibrations are equally near.
    """
    candidates = possible_cameras(image_topic, frame_id, cameras)

    def nearness(topic: str) -> tuple[int, bool, int]:
        camera = candidates[topic]
        same_size = (camera.width, camera.height) == size
        return shared_namespace(image_topic, topic), same_size, -len(namespace(topic))

    if not candidates and cameras:
        others = ", ".join(f"{topic} of {camera.frame_id}" for topic, camera in sorted(cameras.items())[:4])
        raise UnusableCamera(
            f"its camera, of {frame_id}, is not recorded, only others' are ({others}); "
            "give --intrinsics fx,fy,cx,cy"
        )
    if not candidates:
        return None
    best = max(map(nearness, candidates))
    nearest = sorted(topic for topic in candidates if nearness(topic) == best)
    first = candidates[nearest[0]]
    if any(not np.array_equal(first.K, candidates[topic].K, equal_nan=True) for topic in nearest):
        raise UnusableCamera(f"its camera could be {' or '.join(nearest)}; give --intrinsics fx,fy,cx,cy")
    return nearest[0], first


def possible_cameras(
    image_topic: str, frame_id: str, cameras: Mapping[str, CameraMessage]
) -> dict[str, CameraMessage]:
    """The cameras that may have taken the images of a topic: those of their frame, if there are any.

    Else those beside the images or above them, and those of which either side does not name its frame.
    """
    same_frame = {topic: c for topic, c in cameras.items() if frame_id and is_frame(c.frame_id, frame_id)}
    return same_frame or {
        topic: camera
        for topic, camera in cameras.items()
        if not (frame_id and camera.frame_id) or _is_beside(topic, image_topic)
    }


def is_frame(frame_id: str, other: str) -> bool:
    """Whether two names are of one frame."""
    return frame_name(frame_id) == frame_name(other)


def frame_name(frame_id: str) -> str:
    """A frame's name without the slash that ROS 1 puts before it."""
    return frame_id.lstrip("/")


def _is_beside(camera_topic: str, image_topic: str) -> bool:
    """Whether a camera's namespace is the images' topic itself, or lies above it."""
    own, above = (
        (*namespace(image_topic), base_topic(image_topic).rpartition("/")[2]),
        namespace(camera_topic),
    )
    return own[: len(above)] == above


def shared_namespace(topic: str, other: str) -> int:
    """How many leading parts the namespaces of two topics have in common."""
    count = 0
    for a, b in zip(namespace(topic), namespace(other), strict=False):
        if a != b:
            break
        count += 1
    return count
