"""Foxglove's messages (https://docs.foxglove.dev/docs/sdk/schemas), in protobuf and in JSON.

Both encodings are turned into objects with the same attributes; only stamps and bytes are spelled
differently (`seconds`, `nanos` and bytes against `sec`, `nsec` and base64).
"""

from __future__ import annotations

import base64
import importlib
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from mcap.records import Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap_protobuf.decoder import DecoderFactory

from recordings.messages.types import (
    CameraMessage,
    CompressedImageMessage,
    DecodedMessage,
    ImageMessage,
    OdometryMessage,
    PointCloudMessage,
    PointField,
    PoseMessage,
    TransformMessage,
    UndecodableMessage,
    rigid_matrix,
    usable_transforms,
)

_NUMERIC_TYPES = {1: "<u1", 2: "<i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
"""foxglove.PackedElementField.NumericType; fields of others (0 is unknown) are passed over."""


def protobuf_decoder(
    schema_name: str, schema_encoding: str, schema_data: bytes
) -> Callable[[bytes], DecodedMessage] | None:
    """The decoder of a protobuf schema, or None where its messages say nothing that a recording needs.

    Where the file brings no descriptors, those of the foxglove-schemas-protobuf package serve.
    """
    convert = _CONVERSIONS.get(schema_name)
    if convert is None:
        return None
    if schema_encoding == SchemaEncoding.Protobuf and schema_data:
        schema = Schema(id=1, name=schema_name, encoding=schema_encoding, data=schema_data)
        parse = DecoderFactory().decoder_for(MessageEncoding.Protobuf, schema)
        assert parse is not None
    else:
        name = schema_name.removeprefix("foxglove.")
        module = importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2")
        parse = getattr(module, name).FromString
    return lambda data: convert(parse(data))


def json_decoder(schema_name: str) -> Callable[[bytes], DecodedMessage] | None:
    """The decoder of a JSON schema, or None where its messages say nothing that a recording needs."""
    convert = _CONVERSIONS.get(schema_name)
    if convert is None:
        return None
    return lambda data: convert(json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields)))


def _stamp_ns(stamp: Any) -> int:
    if hasattr(stamp, "sec"):
        return int(stamp.sec) * 1_000_000_000 + int(stamp.nsec)
    return stamp.seconds * 1_000_000_000 + stamp.nanos


def _bytes(data: bytes | str | list[int]) -> bytes:
    """Bytes of protobuf, or of JSON: base64, or as some writers have it a list of numbers."""
    if isinstance(data, str):
        return base64.b64decode(data, validate=True)
    if not isinstance(data, bytes | list):
        raise UndecodableMessage(f"has {type(data).__name__} for its bytes")
    return bytes(data)


def _image(message: Any) -> ImageMessage:
    return ImageMessage(
        stamp_ns=_stamp_ns(message.timestamp),
        frame_id=str(message.frame_id),
        width=int(message.width),
        height=int(message.height),
        encoding=str(message.encoding),
        step=int(message.step),
        big_endian=False,
        data=_bytes(message.data),
    )


def _compressed_image(message: Any) -> CompressedImageMessage:
    return CompressedImageMessage(
        stamp_ns=_stamp_ns(message.timestamp),
        frame_id=str(message.frame_id),
        format=str(message.format),
        data=_bytes(message.data),
    )


def _camera(message: Any) -> CameraMessage:
    # JSON may leave out what protobuf would leave empty.
    given = getattr(message, "P", ())
    projection = np.zeros(12)
    projection[: len(given)] = given
    return CameraMessage(
        stamp_ns=_stamp_ns(message.timestamp),
        frame_id=str(message.frame_id),
        width=int(message.width),
        height=int(message.height),
        distortion_model=str(getattr(message, "distortion_model", "")),
        distortion=tuple(map(float, getattr(message, "D", ()))),
        K=np.reshape(np.asarray(message.K, np.float64), (3, 3)),
        P=projection.reshape(3, 4),
    )


def _point_cloud(message: Any) -> PointCloudMessage:
    data, stride = _bytes(message.data), int(message.point_stride)
    width = len(data) // max(1, stride)
    return PointCloudMessage(
        stamp_ns=_stamp_ns(message.timestamp),
        frame_id=str(message.frame_id),
        width=width,
        height=1,
        fields=tuple(
            PointField(name=str(f.name), offset=int(f.offset), dtype=np.dtype(_NUMERIC_TYPES[f.type]))
            for f in message.fields
            if f.type in _NUMERIC_TYPES
        ),
        point_step=stride,
        row_step=width * stride,
        data=data,
        frame_from_points=_cloud_pose(message),
    )


def _cloud_pose(message: Any) -> np.ndarray:
    """The cloud's own pose in its frame, which most writers leave empty."""
    pose = getattr(message, "pose", None)
    if pose is None or not any(getattr(pose.orientation, axis) for axis in "xyzw"):
        return np.eye(4)
    return _matrix(pose.position, pose.orientation)


def _matrix(translation: Any, rotation: Any) -> np.ndarray:
    return rigid_matrix(
        (translation.x, translation.y, translation.z), (rotation.x, rotation.y, rotation.z, rotation.w)
    )


def _transform(message: Any) -> tuple[TransformMessage, ...]:
    return (
        TransformMessage(
            stamp_ns=_stamp_ns(message.timestamp),
            parent=str(message.parent_frame_id),
            child=str(message.child_frame_id),
            parent_from_child=_matrix(message.translation, message.rotation),
        ),
    )


def _transforms(message: Any) -> tuple[TransformMessage, ...]:
    return usable_transforms(message.transforms, _transform)


def _pose(message: Any) -> PoseMessage:
    return PoseMessage(
        stamp_ns=_stamp_ns(message.timestamp),
        frame_id=str(message.frame_id),
        frame_from_body=_matrix(message.pose.position, message.pose.orientation),
    )


def _odometry(message: Any) -> OdometryMessage:
    return OdometryMessage(
        transform=TransformMessage(
            stamp_ns=_stamp_ns(message.timestamp),
            parent=str(message.frame_id),
            child=str(message.body_frame_id),
            parent_from_child=_matrix(message.pose.position, message.pose.orientation),
        )
    )


_CONVERSIONS: dict[str, Callable[[Any], DecodedMessage]] = {
    "foxglove.RawImage": _image,
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.CameraCalibration": _camera,
    "foxglove.PointCloud": _point_cloud,
    "foxglove.FrameTransform": _transform,
    "foxglove.FrameTransforms": _transforms,
    "foxglove.PoseInFrame": _pose,
    "foxglove.Odometry": _odometry,
}
