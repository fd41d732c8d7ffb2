"""The ROS 2 messages that are read: their definitions, and encoding those that we write (rosbags' types)."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recordings.messages.types import quaternion_xyzw
from recordings.types import CameraIntrinsics

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_SECOND_NS = 1_000_000_000
_LAST_SECOND = (1 << 31) - 1
_DRIVERS_MESSAGES = {
    "realsense2_camera_msgs/msg/Extrinsics": "float64[9] rotation\nfloat64[3] translation\n",
}
"""Definitions of drivers' own messages, for bags that do not bring them."""


@cache
def standard_definition(name: str) -> str:
    """The text of a standard message definition with all that it refers to.

    Raises:
        KeyError: no standard message has that name.
    """
    text, _ = _typestore().generate_msgdef(name, ros_version=2)
    return text


def encode(message: Any) -> tuple[str, bytes]:
    """The type name of one of the messages below, and its bytes in CDR."""
    name = message.__msgtype__
    return name, bytes(_typestore().serialize_cdr(message, name))


def cdr_from_ros1(data: bytes, name: str) -> bytes:
    """A ROS 1 message of a standard type in the encoding of ROS 2."""
    return bytes(_typestore().ros1_to_cdr(data, name))


def image(time_ns: int, frame_id: str, encoding: str, pixels: NDArray) -> Any:
    """A sensor_msgs/msg/Image of (H, W) or (H, W, C) little-endian pixels without padding."""
    rows = np.ascontiguousarray(pixels)
    return _new(
        "sensor_msgs/msg/Image",
        header=_header(time_ns, frame_id),
        height=rows.shape[0],
        width=rows.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=rows.strides[0],
        data=rows.reshape(-1).view(np.uint8),
    )


def camera_info(time_ns: int, frame_id: str, camera: CameraIntrinsics) -> Any:
    """A sensor_msgs/msg/CameraInfo of an undistorted camera."""
    projection = np.array([[camera.fx, 0, camera.cx, 0], [0, camera.fy, camera.cy, 0], [0, 0, 1, 0.0]])
    no_region = _new(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return _new(
        "sensor_msgs/msg/CameraInfo",
        header=_header(time_ns, frame_id),
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=projection[:, :3].ravel(),
        r=np.eye(3).ravel(),
        p=projection.ravel(),
        binning_x=0,
        binning_y=0,
        roi=no_region,
    )


def transform(time_ns: int, parent: str, child: str, parent_from_child: NDArray[np.floating]) -> Any:
    """A tf2_msgs/msg/TFMessage of one rigid transform (4, 4)."""
    x, y, z = (float(value) for value in parent_from_child[:3, 3])
    qx, qy, qz, qw = quaternion_xyzw(np.asarray(parent_from_child[:3, :3], np.float64))
    stamped = _new(
        "geometry_msgs/msg/TransformStamped",
        header=_header(time_ns, parent),
        child_frame_id=child,
        transform=_new(
            "geometry_msgs/msg/Transform",
            translation=_new("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=_new("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        ),
    )
    return _new("tf2_msgs/msg/TFMessage", transforms=[stamped])


def _header(time_ns: int, frame_id: str) -> Any:
    seconds, nanoseconds = divmod(time_ns, _SECOND_NS)
    if not 0 <= seconds <= _LAST_SECOND:
        raise ValueError(f"ROS has no stamp for {time_ns} ns: it counts from 1970 to 2038")
    stamp = _new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return _new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def _new(name: str, **fields: Any) -> Any:
    return _typestore().types[name](**fields)


@cache
def _typestore() -> Typestore:
    from rosbags.typesys import (  # takes 0.15 s, and reading seldom needs it
        Stores,
        get_types_from_msg,
        get_typestore,
    )

    store = get_typestore(Stores.ROS2_JAZZY)
    for name, definition in _DRIVERS_MESSAGES.items():
        store.register(get_types_from_msg(definition, name))
    return store
