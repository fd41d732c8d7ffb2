"""Recordings as other programs write them: any message, any container setting."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import Message as ProtobufMessage
from mcap.writer import CompressionType, IndexType, Writer
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SECOND_NS = 1_000_000_000
STORE = get_typestore(Stores.ROS2_HUMBLE)
ROS1_STORE = get_typestore(Stores.ROS1_NOETIC)
ROS1_STORE.register(
    get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
)
STORE.register(
    get_types_from_msg("float64[9] rotation\nfloat64[3] translation", "realsense2_camera_msgs/msg/Extrinsics")
)

CONTAINERS: dict[str, dict[str, Any]] = {
    "zstd": {},
    "lz4 without message index": {
        "compression": CompressionType.LZ4,
        "index_types": IndexType.CHUNK | IndexType.METADATA,
    },
    "no compression": {"compression": CompressionType.NONE},
    "no checksums": {"enable_crcs": False},
    "no chunks": {"use_chunking": False},
    "no chunks, data checksum": {"use_chunking": False, "enable_data_crcs": True},
    "no summary": {
        "use_statistics": False,
        "use_summary_offsets": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "index_types": IndexType.NONE,
    },
}
"""Settings of the container that recorders use."""


def new(name: str, /, **fields: Any) -> Any:
    """A ROS 2 message."""
    return STORE.types[name](**fields)


def header(time_ns: int, frame_id: str = "camera") -> Any:
    """A std_msgs/msg/Header."""
    seconds, nanoseconds = divmod(time_ns, SECOND_NS)
    stamp = new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def image(time_ns: int, encoding: str, rows: np.ndarray, frame_id: str = "camera", **fields: Any) -> Any:
    """A sensor_msgs/msg/Image of (H, W) or (H, W, C) pixels; `fields` override what follows from them."""
    rows = np.ascontiguousarray(rows)
    values = {
        "height": rows.shape[0],
        "width": rows.shape[1],
        "step": rows.strides[0],
        "is_bigendian": 0,
        "data": rows.reshape(-1).view(np.uint8),
        **fields,
    }
    return new("sensor_msgs/msg/Image", header=header(time_ns, frame_id), encoding=encoding, **values)


def compressed_image(time_ns: int, format_: str, data: bytes, frame_id: str = "camera") -> Any:
    """A sensor_msgs/msg/CompressedImage."""
    return new(
        "sensor_msgs/msg/CompressedImage",
        header=header(time_ns, frame_id),
        format=format_,
        data=np.frombuffer(data, np.uint8),
    )


def camera_info(
    time_ns: int,
    size: tuple[int, int],
    intrinsics: tuple[float, float, float, float],
    frame_id: str = "camera",
    **fields: Any,
) -> Any:
    """A sensor_msgs/msg/CameraInfo; `fields` such as d, distortion_model, binning_x, roi override."""
    fx, fy, cx, cy = intrinsics
    k = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
    values = {
        "distortion_model": "plumb_bob",
        "d": np.zeros(5),
        "k": k,
        "r": np.eye(3).ravel(),
        "p": np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0]),
        "binning_x": 0,
        "binning_y": 0,
        "roi": region(0, 0, 0, 0),
        **fields,
    }
    return new(
        "sensor_msgs/msg/CameraInfo",
        header=header(time_ns, frame_id),
        width=size[0],
        height=size[1],
        **values,
    )


def region(x: int, y: int, width: int, height: int) -> Any:
    """A sensor_msgs/msg/RegionOfInterest."""
    return new(
        "sensor_msgs/msg/RegionOfInterest",
        x_offset=x,
        y_offset=y,
        width=width,
        height=height,
        do_rectify=False,
    )


def transform(time_ns: int, parent: str, child: str, translation=(0, 0, 0), xyzw=(0, 0, 0, 1)) -> Any:
    """A tf2_msgs/msg/TFMessage of one transform."""
    x, y, z = map(float, translation)
    qx, qy, qz, qw = map(float, xyzw)
    stamped = new(
        "geometry_msgs/msg/TransformStamped",
        header=header(time_ns, parent),
        child_frame_id=child,
        transform=new(
            "geometry_msgs/msg/Transform",
            translation=new("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=new("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        ),
    )
    return new("tf2_msgs/msg/TFMessage", transforms=[stamped])


def pose(translation=(0, 0, 0), xyzw=(0, 0, 0, 1)) -> Any:
    """A geometry_msgs/msg/Pose."""
    x, y, z = map(float, translation)
    qx, qy, qz, qw = map(float, xyzw)
    return new(
        "geometry_msgs/msg/Pose",
        position=new("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=new("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )


def ros1_bytes(message: Any) -> bytes:
    """A ROS 2 message as ROS 1 writes it: headers count, matrices are in capitals."""
    name = message.__msgtype__
    return bytes(ROS1_STORE.serialize_ros1(_as_ros1(message), name))


def _as_ros1(message: Any) -> Any:
    kind: Any = ROS1_STORE.types[message.__msgtype__]
    fields: dict[str, Any] = {}
    for key in kind.__dataclass_fields__:
        if key != "__msgtype__":
            value = 3 if key == "seq" else getattr(message, key, None)
            value = getattr(message, key.lower()) if value is None else value
            if isinstance(value, list):
                value = [_as_ros1(item) for item in value]
            fields[key] = _as_ros1(value) if hasattr(value, "__msgtype__") else value
    return kind(**fields)


class Scribe:
    """Writes messages of any kind into an MCAP file; a context manager."""

    def __init__(self, path: Path, *, chunk_size: int = 6000, **container: Any) -> None:
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=chunk_size, **container)
        self._writer.start("ros2", "somebody else")
        self._channels: dict[str, int] = {}

    def __enter__(self) -> Scribe:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.finish()
        self._file.close()

    def ros2(
        self,
        topic: str,
        message: Any,
        log_time_ns: int,
        *,
        schema_name: str | None = None,
        schema: tuple[str, bytes] | None = None,
    ) -> None:
        """A ROS 2 message; `schema` (encoding, data) replaces the standard definition."""
        name = message.__msgtype__
        text = STORE.generate_msgdef(name, ros_version=2)[0].encode()
        encoding, data = schema or ("ros2msg", text)
        content = bytes(STORE.serialize_cdr(message, name))
        self.raw(topic, (schema_name or name, encoding, data), "cdr", content, log_time_ns)

    def protobuf(self, topic: str, message: ProtobufMessage, log_time_ns: int) -> None:
        """A protobuf message with its descriptors."""
        descriptors = build_file_descriptor_set(type(message)).SerializeToString()
        schema = (message.DESCRIPTOR.full_name, "protobuf", descriptors)
        self.raw(topic, schema, "protobuf", message.SerializeToString(), log_time_ns)

    def json(self, topic: str, schema_name: str, message: dict[str, Any], log_time_ns: int) -> None:
        """A JSON message; bytes become base64."""
        content = json.dumps(message, default=lambda data: base64.b64encode(data).decode()).encode()
        self.raw(topic, (schema_name, "jsonschema", b"{}"), "json", content, log_time_ns)

    def raw(
        self, topic: str, schema: tuple[str, str, bytes], encoding: str, data: bytes, log_time_ns: int
    ) -> None:
        """Any message."""
        if topic not in self._channels:
            schema_id = self._writer.register_schema(*schema)
            self._channels[topic] = self._writer.register_channel(topic, encoding, schema_id)
        self._writer.add_message(self._channels[topic], log_time_ns, data, log_time_ns)
