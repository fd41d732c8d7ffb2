"""Reading ROS 2 messages in CDR, decoded by mcap_ros2 from the definition in the file.

Where the file's definition is empty or IDL, the standard definition of that name is used instead.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from contextlib import redirect_stderr
from typing import Any

import numpy as np
import zstandard
from mcap.records import Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_ros2.decoder import DecoderFactory

from recordings.mcap_files.framing import MAX_BLOCK_SIZE
from recordings.messages.ros2_standard import cdr_from_ros1, standard_definition
from recordings.messages.types import (
    CameraMessage,
    CompressedImageMessage,
    DecodedMessage,
    ExtrinsicsMessage,
    ImageMessage,
    NumberMessage,
    OdometryMessage,
    PointCloudMessage,
    PointField,
    PoseMessage,
    TransformMessage,
    UndecodableMessage,
    rigid_matrix,
    usable_transforms,
)

_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""sensor_msgs/msg/PointField's datatypes; fields of others are passed over."""

_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
"""Types of old bags of ROS 1, and the equal ones of today."""
_NO_ROTATION = 1e-3
"""Drivers write single precision; older ones a header before the numbers, which read as none then."""


def canonical_name(schema_name: str) -> str:
    """`package/msg/Type` for `package/Type` and `package::msg::dds_::Type_`, which recorders write too."""
    parts = schema_name.replace("::", "/").split("/")
    parts = [part for part in parts if part not in {"msg", "dds_"}]
    name = f"{parts[0]}/msg/{parts[-1].removesuffix('_')}" if len(parts) == 2 else schema_name
    return _RENAMED.get(name, name)


def decoder(
    schema_name: str, schema_encoding: str, schema_data: bytes
) -> Callable[[bytes], DecodedMessage] | None:
    """The decoder of a schema, or None where its messages say nothing that a recording needs."""
    name = canonical_name(schema_name)
    convert = _CONVERSIONS.get(name)
    if convert is None:
        return None
    text = schema_data
    if schema_encoding != SchemaEncoding.ROS2 or not schema_data.strip():
        text = standard_definition(name).encode()
    schema = Schema(id=1, name=name, encoding=SchemaEncoding.ROS2, data=text)
    with redirect_stderr(io.StringIO()):  # what it raises of a broken definition it prints too
        parse = DecoderFactory().decoder_for(MessageEncoding.CDR, schema)
    assert parse is not None
    return lambda data: convert(parse(_unpacked(data)))


def ros1_decoder(schema_name: str) -> Callable[[bytes], DecodedMessage] | None:
    """The decoder of a ROS 1 type, whose messages differ from those of ROS 2 in encoding alone."""
    name = canonical_name(schema_name)
    decode = decoder(name, "", b"")
    return None if decode is None else lambda data: decode(cdr_from_ros1(data, name))


def _unpacked(data: bytes) -> bytes:
    """Undo rosbag2's `--compression-mode message`, which packs each message by itself."""
    if not data.startswith(zstandard.MAGIC_NUMBER.to_bytes(4, "little")):
        return data
    if zstandard.frame_content_size(data) > MAX_BLOCK_SIZE:
        raise UndecodableMessage(f"claims more than {MAX_BLOCK_SIZE} bytes unpacked")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=MAX_BLOCK_SIZE)


def _stamp_ns(header: Any) -> int:
    return header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def _image(message: Any) -> ImageMessage:
    return ImageMessage(
        stamp_ns=_stamp_ns(message.header),
        frame_id=message.header.frame_id,
        width=message.width,
        height=message.height,
        encoding=message.encoding,
        step=message.step,
        big_endian=bool(message.is_bigendian),
        data=message.data,
    )


def _compressed_image(message: Any) -> CompressedImageMessage:
    return CompressedImageMessage(
        stamp_ns=_stamp_ns(message.header),
        frame_id=message.header.frame_id,
        format=message.format,
        data=message.data,
    )


def _camera(message: Any) -> CameraMessage:
    # ROS 1 definitions, which converters leave in files, write the matrices in capitals.
    d, k, p = (getattr(message, n, None) or getattr(message, n.upper(), ()) for n in ("d", "k", "p"))
    return CameraMessage(
        stamp_ns=_stamp_ns(message.header),
        frame_id=message.header.frame_id,
        width=message.width,
        height=message.height,
        distortion_model=message.distortion_model,
        distortion=tuple(d),
        K=np.reshape(np.asarray(k, np.float64), (3, 3)),
        P=np.reshape(np.asarray(p, np.float64), (3, 4)),
        binning=(max(1, message.binning_x), max(1, message.binning_y)),
        roi=(message.roi.x_offset, message.roi.y_offset, message.roi.width, message.roi.height),
    )


def _point_cloud(message: Any) -> PointCloudMessage:
    order = ">" if message.is_bigendian else "<"
    return PointCloudMessage(
        stamp_ns=_stamp_ns(message.header),
        frame_id=message.header.frame_id,
        width=message.width,
        height=message.height,
        fields=tuple(
            PointField(name=f.name, offset=f.offset, dtype=np.dtype(order + _POINT_TYPES[f.datatype]))
            for f in message.fields
            if f.datatype in _POINT_TYPES
        ),
        point_step=message.point_step,
        row_step=message.row_step,
        data=message.data,
    )


def _matrix(translation: Any, rotation: Any) -> np.ndarray:
    return rigid_matrix(
        (translation.x, translation.y, translation.z), (rotation.x, rotation.y, rotation.z, rotation.w)
    )


def _transforms(message: Any) -> tuple[TransformMessage, ...]:
    return usable_transforms(message.transforms, _transform)


def _transform(message: Any) -> tuple[TransformMessage, ...]:
    return (
        TransformMessage(
            stamp_ns=_stamp_ns(message.header),
            parent=message.header.frame_id,
            child=message.child_frame_id,
            parent_from_child=_matrix(message.transform.translation, message.transform.rotation),
        ),
    )


def _pose(message: Any) -> PoseMessage:
    pose = getattr(message.pose, "pose", message.pose)  # PoseWithCovarianceStamped nests one deeper
    return PoseMessage(
        stamp_ns=_stamp_ns(message.header),
        frame_id=message.header.frame_id,
        frame_from_body=_matrix(pose.position, pose.orientation),
    )


def _odometry(message: Any) -> OdometryMessage:
    pose = message.pose.pose
    return OdometryMessage(
        transform=TransformMessage(
            stamp_ns=_stamp_ns(message.header),
            parent=message.header.frame_id,
            child=message.child_frame_id,
            parent_from_child=_matrix(pose.position, pose.orientation),
        )
    )


def _extrinsics(message: Any) -> ExtrinsicsMessage:
    """RealSense's rs2_extrinsics: nine numbers column by column, which map the first camera's points."""
    rotation = np.reshape(np.asarray(message.rotation, np.float64), (3, 3)).T
    translation = np.asarray(message.translation, np.float64)
    if not (
        np.abs(rotation @ rotation.T - np.eye(3)).max() < _NO_ROTATION and np.isfinite(translation).all()
    ):
        raise UndecodableMessage(f"holds no rotation: {message.rotation}")
    second_from_first = np.eye(4)
    second_from_first[:3, :3], second_from_first[:3, 3] = rotation, translation
    return ExtrinsicsMessage(second_from_first=second_from_first)


def _number(message: Any) -> NumberMessage:
    return NumberMessage(value=float(message.data))


_CONVERSIONS: dict[str, Callable[[Any], DecodedMessage]] = {
    "sensor_msgs/msg/Image": _image,
    "sensor_msgs/msg/CompressedImage": _compressed_image,
    "sensor_msgs/msg/CameraInfo": _camera,
    "sensor_msgs/msg/PointCloud2": _point_cloud,
    "tf2_msgs/msg/TFMessage": _transforms,
    "geometry_msgs/msg/TransformStamped": _transform,
    "geometry_msgs/msg/PoseStamped": _pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose,
    "nav_msgs/msg/Odometry": _odometry,
    "realsense2_camera_msgs/msg/Extrinsics": _extrinsics,
    "std_msgs/msg/Float32": _number,
}

READABLE_TYPES = frozenset(_CONVERSIONS)
"""The messages that a recording can use."""
