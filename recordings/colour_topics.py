"""The colour images that are registered to the depth: only those whose pixels see the same points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recordings.cameras.distortion import Undistortion, is_distorted
from recordings.cameras.matching import is_frame, is_rectified, matching_camera, possible_cameras
from recordings.cameras.pinhole import UnusableCamera, stored_intrinsics
from recordings.depth_images import DepthImages
from recordings.first_colour import first_colour
from recordings.images.colour import ColourMessage, colour_size, is_colour, resampled, rgb_of_size
from recordings.images.compressed_depth import holds_depth
from recordings.images.depth_pixels import DEPTH_DTYPES
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import CameraMessage, CompressedImageMessage, ImageMessage
from recordings.types import CameraIntrinsics

_FOCAL_TOLERANCE = 0.01
_CENTRE_TOLERANCE_PX = 2.0
_GREY = {"mono8", "8UC1"}
"""Infrared and the like: neither depth nor colour."""
_IMAGES = ("Image", "Video", "PointCloud")
"""In the names of messages that could hold depth or colour."""


@dataclass(frozen=True, kw_only=True)
class ColourTopic:
    """A topic of colour images that are registered to a depth topic and its camera.

    Attributes:
        name: of the topic.
        size: width and height of its images.
        camera: of the depth images.
        undistortion: of the depth images, None where they need none.
    """

    name: str
    size: tuple[int, int]
    camera: CameraIntrinsics
    undistortion: Undistortion | None

    def rgb(self, message: ColourMessage) -> NDArray[np.uint8]:
        """The colours (H, W, 3) of the depth image's pixels.

        Raises:
            UndecodableMessage: the image is damaged, or of another size than the first.
        """
        rgb = resampled(rgb_of_size(message, self.size), self.camera.width, self.camera.height)
        return self.undistortion.colour(rgb) if self.undistortion else rgb


def registered_colour(
    decoded: DecodedBag, depth: DepthImages, frame_id: str, cameras: dict[str, CameraMessage]
) -> ColourTopic | None:
    """The first topic of colour images in the depth's own frame and with its camera, if there is one."""
    if depth.intrinsics is None or not frame_id:
        return None
    for topic in decoded.topic_names:
        first = first_colour(decoded, topic)
        if first is None or not is_frame(first.frame_id, frame_id):
            continue
        colour = ColourTopic(
            name=topic,
            size=colour_size(first),
            camera=depth.intrinsics,
            undistortion=depth.undistortion,
        )
        if _sees_the_same(colour, first.frame_id, cameras):
            return colour
    return None


def unread_images(decoded: DecodedBag) -> str | None:
    """A sentence on the first images that are not read: of an unknown type, or neither depth nor colour."""
    for kind in decoded.unread_topics:
        if any(word in kind.schema_name for word in _IMAGES):
            return f"{kind.name} holds {kind.schema_name} ({kind.message_encoding}), which is not read"
    for topic in decoded.topic_names:
        first = decoded.first(topic)
        read = isinstance(first, ImageMessage) and (is_colour(first) or first.encoding in DEPTH_DTYPES)
        if isinstance(first, ImageMessage) and not read and first.encoding not in _GREY:
            return f"{topic} has the encoding {first.encoding!r}, which is not read"
        is_read = first_colour(decoded, topic) is not None
        if isinstance(first, CompressedImageMessage) and not is_read and not holds_depth(first):
            if any(form in first.format.lower() for form in ("png", "jpeg", "jpg")):
                return f"{topic}: its first image is damaged, or neither depth nor colour ({first.format!r})"
            return f"{topic} is compressed as {first.format!r}, which is not read"
    return None


def _sees_the_same(colour: ColourTopic, frame_id: str, cameras: dict[str, CameraMessage]) -> bool:
    """Whether the images of a topic, taken in a frame, are those of the depth's camera."""
    depth = colour.camera
    try:
        own = possible_cameras(colour.name, frame_id, cameras)
        found = matching_camera(colour.name, frame_id, colour.size, own)
        if found is None:
            return colour.size == (depth.width, depth.height)
        camera = found[1]
        rectified = is_rectified(colour.name)
        distorted = not rectified and is_distorted(camera.distortion)
        own = stored_intrinsics(camera, *colour.size, rectified=rectified)
        own = own.resized(depth.width, depth.height)
    except UnusableCamera:
        return False
    return distorted == (colour.undistortion is not None) and _agree(own, depth)


def _agree(a: CameraIntrinsics, b: CameraIntrinsics) -> bool:
    focal = np.abs(np.log([a.fx / b.fx, a.fy / b.fy])).max() < _FOCAL_TOLERANCE
    centre = np.abs([a.cx - b.cx, a.cy - b.cy]).max() < _CENTRE_TOLERANCE_PX
    return bool(focal and centre)
