"""The same three frames through the writers of other projects: mcap_ros2, mcap_protobuf, rosbags."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as Ros2Writer
from PIL import Image
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter

from recordings.importers.formats import import_recording
from recordings.poses.recorded import recorded_trajectory
from recordings.reading import open_recording
from tests.recordings.samples import STORE, camera_info, image, transform

K = (35.0, 36.0, 18.5, 15.25)
STAMPS = [1_700_000_000_000_000_000 + i * 100_000_000 for i in range(3)]
MILLIMETRES = (np.arange(30 * 40).reshape(30, 40) + 500).astype("<u2")
METRES = (MILLIMETRES / 1000).astype("<f4")


def ros2_messages(index: int) -> dict[str, Any]:
    """The ROS 2 messages of a frame by topic."""
    stamp = STAMPS[index]
    return {
        "/depth/camera_info": camera_info(stamp, (40, 30), K),
        "/depth/image": image(stamp, "16UC1", MILLIMETRES),
        "/tf": transform(stamp, "map", "camera", (index, 0, 0)),
    }


def write_mcap_ros2(path: Path) -> None:
    """By mcap_ros2, which takes messages as plain values."""
    schemas = {}
    with path.open("wb") as file, Ros2Writer(file) as writer:
        for index, stamp in enumerate(STAMPS):
            for topic, message in ros2_messages(index).items():
                name = message.__msgtype__
                if name not in schemas:
                    text = STORE.generate_msgdef(name, ros_version=2)[0]
                    schemas[name] = writer.register_msgdef(name, text)
                writer.write_message(topic, schemas[name], plain(message), stamp + 7, stamp)


def plain(value: Any) -> Any:
    """A message as dictionaries, lists, numbers and bytes."""
    if hasattr(value, "__msgtype__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__ if name[:2] != "__"}
    if isinstance(value, np.ndarray):
        return value.tobytes() if value.dtype == np.uint8 else value.tolist()
    return [plain(item) for item in value] if isinstance(value, list) else value


def write_rosbags(path: Path, compression: CompressionMode | None = None) -> None:
    """By rosbags, a folder with its metadata."""
    writer = BagWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    connections = {}
    with writer:
        for index, stamp in enumerate(STAMPS):
            for topic, message in ros2_messages(index).items():
                name = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, name, typestore=STORE)
                writer.write(connections[topic], stamp, STORE.serialize_cdr(message, name))


def write_mcap_protobuf(path: Path, encoding: str) -> None:
    """By mcap_protobuf in Foxglove's schemas; fields that need no value are left empty."""
    fx, fy, cx, cy = K
    with path.open("wb") as file, ProtobufWriter(file) as writer:
        for index, stamp in enumerate(STAMPS):
            time = Timestamp()
            time.FromNanoseconds(stamp)
            common: dict[str, Any] = {"timestamp": time, "frame_id": "camera"}
            size: dict[str, Any] = {"width": 40, "height": 30}
            transforms = FrameTransforms()
            one = transforms.transforms.add(timestamp=time, parent_frame_id="map", child_frame_id="camera")
            one.translation.x, one.rotation.w = index, 1
            messages = {
                "/calibration": CameraCalibration(**common, **size, K=[fx, 0, cx, 0, fy, cy, 0, 0, 1]),
                "/depth": foxglove_image(encoding, common, size),
                "/transforms": transforms,
            }
            for topic, message in messages.items():
                writer.write_message(topic, message, stamp + 7, stamp)


def foxglove_image(encoding: str, common: dict[str, Any], size: dict[str, Any]) -> RawImage | CompressedImage:
    """The depth as a foxglove.RawImage, or a foxglove.CompressedImage where the encoding is png."""
    if encoding == "png":
        buffer = io.BytesIO()
        Image.fromarray(MILLIMETRES).save(buffer, "PNG")
        return CompressedImage(**common, format="png", data=buffer.getvalue())
    pixels = METRES if encoding == "32FC1" else MILLIMETRES
    return RawImage(**common, **size, encoding=encoding, step=pixels.strides[0], data=pixels.tobytes())


WRITERS: dict[str, Callable[[Path], None]] = {
    "mcap_ros2": write_mcap_ros2,
    "rosbags": write_rosbags,
    "rosbags, files compressed": lambda path: write_rosbags(path, CompressionMode.FILE),
    "rosbags, messages compressed": lambda path: write_rosbags(path, CompressionMode.MESSAGE),
    **{
        f"mcap_protobuf, {encoding}": lambda path, encoding=encoding: write_mcap_protobuf(path, encoding)
        for encoding in ("16UC1", "mono16", "32FC1", "png")
    },
}


def assert_the_frames(path: Path) -> None:
    """Frames, stamps, camera and poses are those that were written."""
    recording = open_recording(path)
    camera = recording.intrinsics
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == K
    assert [frame.time_ns for frame in recording] == STAMPS
    for frame in recording:
        np.testing.assert_array_equal(frame.depth_m, METRES)
    assert not recording.damage
    trajectory = recorded_trajectory(path)
    assert trajectory is not None
    np.testing.assert_array_equal(trajectory.reference_from_camera[:, 0, 3], [0, 1, 2])


@pytest.mark.parametrize("name", WRITERS)
def test_their_recordings_are_read(name, tmp_path):
    """As they are."""
    path = tmp_path / ("recording" if name.startswith("rosbags") else "recording.mcap")
    WRITERS[name](path)
    assert_the_frames(path)


@pytest.mark.parametrize("name", [name for name in WRITERS if name.startswith("rosbags")])
def test_their_bags_are_imported(name, tmp_path):
    """Into one file that holds the same."""
    WRITERS[name](tmp_path / "bag")
    out = tmp_path / "recording.mcap"
    remarks = import_recording(
        "bag", tmp_path / "bag", out, frames=slice(None), intrinsics=None, progress=lambda *_: None
    )
    assert remarks == ()
    assert_the_frames(out)
