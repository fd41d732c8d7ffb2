"""The cameras that a recording describes, and when one of them changes."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from recordings.cameras.matching import is_frame
from recordings.cameras.pinhole import is_calibrated
from recordings.messages.decoded_bag import DecodedBag
from recordings.messages.types import CameraMessage
from recordings.stamps import in_order_of_stamps

_JITTER_PX = 0.25
"""Calibrations whose pixels differ by less are one: drivers round them anew in each message."""


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


@dataclass(frozen=True, kw_only=True)
class CameraTrack:
    """The calibrations of one camera over time.

    Attributes:
        cameras: one for each stretch of time.
        starts_ns: (len(cameras) - 1) where the second and each later stretch begins.
    """

    cameras: tuple[CameraMessage, ...]
    starts_ns: tuple[int, ...]

    def at(self, time_ns: int) -> CameraMessage:
        """The calibration that holds at a time."""
        return self.cameras[bisect_right(self.starts_ns, time_ns)]


def camera_track(
    decoded: DecodedBag, topic: str, first: CameraMessage, *, uses_log_time: bool
) -> CameraTrack:
    """Every calibration that a camera topic tells of the camera of `first`, read from end to end.

    A stretch begins half-way between the last message of the one before it and its own first, in the order of
    stamps, as the images are. Messages of another frame, or from before a driver knows its calibration, are
    passed over.
    """

    def stamped() -> Iterator[tuple[int, CameraMessage]]:
        for log_time_ns, message in decoded.messages({topic}):
            if (
                isinstance(message, CameraMessage)
                and is_frame(message.frame_id, first.frame_id)
                and is_calibrated(message)
            ):
                yield log_time_ns if uses_log_time or message.stamp_ns == 0 else message.stamp_ns, message

    cameras, starts_ns, last_ns = [first], list[int](), 0
    for time_ns, message in in_order_of_stamps(stamped(), leave_out=lambda _: None):
        if not _is_same(message, cameras[-1]):
            cameras.append(message)
            starts_ns.append((last_ns + time_ns + 1) // 2 if last_ns else time_ns)
        last_ns = time_ns
    return CameraTrack(cameras=tuple(cameras), starts_ns=tuple(starts_ns))


def _is_same(one: CameraMessage, other: CameraMessage) -> bool:
    if (one.width, one.height, one.binning, one.roi) != (other.width, other.height, other.binning, other.roi):
        return False
    if one.distortion_model != other.distortion_model:
        return False
    corner = np.array([max(one.width, 1), max(one.height, 1), 1.0])
    return np.array_equal(one.distortion, other.distortion, equal_nan=True) and all(
        _moves_px(a, b, corner) < _JITTER_PX for a, b in ((one.K, other.K), (one.P[:, :3], other.P[:, :3]))
    )


def _moves_px(one: np.ndarray, other: np.ndarray, corner: np.ndarray) -> float:
    """By how much at most a pixel of the image lies elsewhere under another matrix."""
    if np.array_equal(one, other):
        return 0.0
    corners = np.array([[0.0, 0.0, 1.0], [corner[0], 0.0, 1.0], [0.0, corner[1], 1.0], corner]).T
    with np.errstate(all="ignore"):  # numbers of no camera overflow: it is another one
        if not (np.isfinite(one).all() and np.isfinite(other).all() and abs(np.linalg.det(one)) > 0):
            return np.inf
        moved = other @ np.linalg.inv(one) @ corners
        return float(np.abs(moved[:2] - corners[:2]).max())
