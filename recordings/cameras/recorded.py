"""The cameras that a recording describes."""

from __future__ import annotations

from recordings.cameras.pinhole import is_calibrated
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import CameraMessage


def recorded_cameras(decoded: DecodedBag) -> dict[str, CameraMessage]:
    """The first calibrated message of each camera topic; drivers send zeros before they know more."""
    cameras: dict[str, CameraMessage] = {}
    for topic in decoded.topic_names:
        if isinstance(decoded.first(topic), CameraMessage):
            for _, message in decoded.messages({topic}):
                if isinstance(message, CameraMessage) and is_calibrated(message):
                    cameras[topic] = message
                    break
    return cameras
