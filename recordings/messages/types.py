"""The common values that messages of every encoding are decoded into.

Stamps are integer nanoseconds, 0 where the message has none. Poses are `target_from_source`; quaternions
are xyzw as ROS and Foxglove write them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


class UndecodableMessage(Exception):  # noqa: N818  (never leaves recordings)
    """A message does not hold what its schema says; the text completes "the message ..."."""


@dataclass(frozen=True, kw_only=True)
class ImageMessage:
    """An image as rows of pixels: `step` bytes a row, of which the first ones are pixels."""

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    encoding: str
    step: int
    big_endian: bool
    data: bytes


@dataclass(frozen=True, kw_only=True)
class CompressedImageMessage:
    """An image in a compressed format, which `format` names in the words of its writer."""

    stamp_ns: int
    frame_id: str
    format: str
    data: bytes


@dataclass(frozen=True, kw_only=True)
class CameraMessage:
    """A camera's calibration at full resolution, and the part of the sensor that its images show.

    Attributes:
        distortion: coefficients of `distortion_model` in the order of ROS.
        K: (3, 3) intrinsics of the image as the sensor takes it.
        P: (3, 4) projection of the rectified image; zeros where not given.
        binning: (x, y) sensor pixels a pixel of the image; 1 without binning.
        roi: (x, y, width, height) in full-resolution pixels; zero size for the whole sensor.
    """

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    distortion_model: str
    distortion: tuple[float, ...]
    K: NDArray[np.float64]
    P: NDArray[np.float64]
    binning: tuple[int, int] = (1, 1)
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)


@dataclass(frozen=True, kw_only=True)
class PointField:
    """Where one number of a point lies: bytes from the point's start, and its NumPy type."""

    name: str
    offset: int
    dtype: np.dtype


@dataclass(frozen=True, kw_only=True)
class PointCloudMessage:
    """Packed points; `height` above 1 where they keep the rows and columns of a sensor.

    `frame_from_points` maps the points into the frame `frame_id`.
    """

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    fields: tuple[PointField, ...]
    point_step: int
    row_step: int
    data: bytes
    frame_from_points: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True, kw_only=True)
class TransformMessage:
    """A rigid transform between two named frames at one time."""

    stamp_ns: int
    parent: str
    child: str
    parent_from_child: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ExtrinsicsMessage:
    """A rigid transform (4, 4) between two cameras of one device, which the topic's name alone tells."""

    second_from_first: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class OdometryMessage:
    """Where a body is in a fixed frame by its own reckoning; transforms on /tf usually say the same."""

    transform: TransformMessage


@dataclass(frozen=True, kw_only=True)
class PoseMessage:
    """A pose in a named frame, of something that the message does not name."""

    stamp_ns: int
    frame_id: str
    frame_from_body: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class NumberMessage:
    """A number, of which the topic's name alone says what it is."""

    value: float


DecodedMessage = (
    ImageMessage
    | CompressedImageMessage
    | CameraMessage
    | PointCloudMessage
    | OdometryMessage
    | PoseMessage
    | ExtrinsicsMessage
    | NumberMessage
    | tuple[TransformMessage, ...]
)


def usable_transforms(
    messages: Iterable[Any], convert: Callable[[Any], tuple[TransformMessage, ...]]
) -> tuple[TransformMessage, ...]:
    """The transforms of a message that holds several, without those that are none, as tf2 passes over them.

    Args:
        messages: of one transform each.
        convert: gives the transform of one of them.

    Raises:
        UndecodableMessage: there are some, and none can be used.
    """
    found: list[TransformMessage] = []
    problem: UndecodableMessage | None = None
    for message in messages:
        try:
            found += convert(message)
        except UndecodableMessage as error:
            problem = error
    if problem is not None and not found:
        raise problem
    return tuple(found)


def rigid_matrix(
    translation: tuple[float, float, float], xyzw: tuple[float, float, float, float]
) -> NDArray[np.float64]:
    """The 4x4 transform of a translation in metres and a quaternion, which need not be normalised.

    Raises:
        UndecodableMessage: a number is not finite, or the quaternion is zero.
    """
    x, y, z, w = quaternion = np.asarray(xyzw, np.float64)
    squared = float(quaternion @ quaternion)
    if not (np.isfinite(translation).all() and np.isfinite(squared) and squared > 1e-12):
        raise UndecodableMessage(f"holds no rigid transform: translation {translation}, quaternion {xyzw}")
    s = 2.0 / squared
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    matrix[:3, 3] = translation
    return matrix


def quaternion_xyzw(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """The quaternion of a 3x3 rotation, by its largest component (Shepperd 1978), w >= 0."""
    m = rotation
    squares = np.array(
        [
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
            1 + m[0, 0] + m[1, 1] + m[2, 2],
        ]
    )
    products = np.array(
        [
            [0, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
            [m[0, 1] + m[1, 0], 0, m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 0, m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 0],
        ]
    )
    largest = int(np.argmax(squares))
    quaternion = products[largest] + np.eye(4)[largest] * squares[largest]
    quaternion = quaternion / np.linalg.norm(quaternion)
    x, y, z, w = (quaternion if quaternion[3] >= 0 else -quaternion).tolist()
    return x, y, z, w
