"""The same recording in every message encoding, and with schemas that are missing or foreign."""

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp

from recordings.messages.ros2 import canonical_name, decoder
from recordings.messages.types import quaternion_xyzw, rigid_matrix
from recordings.options import ReadOptions
from recordings.poses.recorded import recorded_trajectory
from recordings.reading import open_recording
from tests.recordings.samples import ROS1_STORE, STORE, Scribe, camera_info, image, ros1_bytes, transform

K = (35.0, 36.0, 18.5, 15.25)
STAMPS = [1_700_000_000_000_000_000 + i * 33_333_333 for i in range(3)]
DEPTH = (np.arange(30 * 40).reshape(30, 40) + 500).astype("<u2")
IDL = ("ros2idl", b"module sensor_msgs { module msg { struct Image { }; }; };")


def write_ros2(path, *, schema=None, spelling=lambda name: name):
    """Depth, camera and pose as ROS 2 messages with the given schema and spelling of its name."""
    with Scribe(path) as scribe:
        for i, stamp in enumerate(STAMPS):
            for topic, message in {
                "/c/camera_info": camera_info(stamp, (40, 30), K),
                "/c/depth": image(stamp, "16UC1", DEPTH),
                "/tf": transform(stamp, "world", "camera", (i, 0, 0)),
            }.items():
                name = spelling(message.__msgtype__)
                scribe.ros2(topic, message, stamp + 1000, schema_name=name, schema=schema)


def write_ros1(path, *, spelling=lambda name: name.replace("/msg/", "/")):
    """The same as ROS 1 messages."""
    with Scribe(path) as scribe:
        for i, stamp in enumerate(STAMPS):
            for topic, message in {
                "/c/camera_info": camera_info(stamp, (40, 30), K),
                "/c/depth": image(stamp, "16UC1", DEPTH),
                "/tf": transform(stamp, "world", "camera", (i, 0, 0)),
            }.items():
                name = message.__msgtype__
                text = ROS1_STORE.generate_msgdef(name)[0].encode()
                schema = (spelling(name), "ros1msg", text)
                scribe.raw(topic, schema, "ros1", ros1_bytes(message), stamp)


def write_protobuf(path):
    """The same as Foxglove protobuf."""
    with Scribe(path) as scribe:
        for i, stamp in enumerate(STAMPS):
            time = Timestamp()
            time.FromNanoseconds(stamp)
            scribe.protobuf("/c/calibration", CameraCalibration(timestamp=time, **calibration()), stamp)
            scribe.protobuf("/c/depth", RawImage(timestamp=time, **raw_image()), stamp)
            moved = FrameTransform(timestamp=time, parent_frame_id="world", child_frame_id="camera")
            moved.translation.x = i
            moved.rotation.w = 1
            scribe.protobuf("/moves", moved, stamp)


def write_json(path):
    """The same as Foxglove JSON."""
    with Scribe(path) as scribe:
        for i, stamp in enumerate(STAMPS):
            time = {"timestamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9}}
            scribe.json("/c/calibration", "foxglove.CameraCalibration", {**time, **calibration()}, stamp)
            scribe.json("/c/depth", "foxglove.RawImage", {**time, **raw_image()}, stamp)
            one = {
                **time,
                "parent_frame_id": "world",
                "child_frame_id": "camera",
                "translation": {"x": i, "y": 0, "z": 0},
                "rotation": {"x": 0, "y": 0, "z": 0, "w": 1},
            }
            scribe.json("/moves", "foxglove.FrameTransforms", {"transforms": [one]}, stamp)


def calibration() -> dict:
    """The fields of a foxglove.CameraCalibration."""
    fx, fy, cx, cy = K
    return {
        "frame_id": "camera",
        "width": 40,
        "height": 30,
        "distortion_model": "plumb_bob",
        "D": [0, 0, 0, 0, 0],
        "K": [fx, 0, cx, 0, fy, cy, 0, 0, 1],
        "R": [1, 0, 0, 0, 1, 0, 0, 0, 1],
        "P": [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
    }


def raw_image() -> dict:
    """The fields of a foxglove.RawImage."""
    return {
        "frame_id": "camera",
        "width": 40,
        "height": 30,
        "encoding": "16UC1",
        "step": 80,
        "data": DEPTH.tobytes(),
    }


WRITERS = {
    "ROS 2": write_ros2,
    "ROS 2, empty schemas": lambda path: write_ros2(path, schema=("ros2msg", b"")),
    "ROS 2, no schema encoding": lambda path: write_ros2(path, schema=("", b"")),
    "ROS 2, IDL schemas": lambda path: write_ros2(path, schema=IDL),
    "ROS 2, names without msg": lambda path: write_ros2(path, spelling=lambda n: n.replace("/msg/", "/")),
    "ROS 2, names of DDS": lambda path: write_ros2(
        path, schema=IDL, spelling=lambda n: n.replace("/msg/", "::msg::dds_::") + "_"
    ),
    "ROS 1": write_ros1,
    "ROS 1, transforms of tf": lambda path: write_ros1(
        path, spelling=lambda n: n.replace("/msg/", "/").replace("tf2_msgs/TFMessage", "tf/tfMessage")
    ),
    "Foxglove protobuf": write_protobuf,
    "Foxglove JSON": write_json,
}


@pytest.mark.parametrize(
    ("data", "is_read"), [(list(DEPTH.tobytes()), True), ([300, -1], False), (7, False), (None, False)]
)
def test_bytes_of_json_may_be_numbers(data, is_read, recording_path):
    """In place of base64; what is neither costs the message."""
    with Scribe(recording_path) as scribe:
        for i, content in enumerate([raw_image(), {**raw_image(), "data": data}]):
            time = {"timestamp": {"sec": 5, "nsec": i}}
            scribe.json("/c/depth", "foxglove.RawImage", {**time, **content}, i)
    recording = open_recording(recording_path, ReadOptions(intrinsics=K))
    assert len(list(recording)) == 1 + is_read
    assert recording.damage.lost_messages == 1 - is_read


@pytest.mark.parametrize("writer", WRITERS)
def test_every_encoding_gives_the_same_recording(writer, recording_path):
    """Frames, stamps, camera and poses do not depend on how the messages are encoded."""
    WRITERS[writer](recording_path)
    recording = open_recording(recording_path)
    trajectory = recorded_trajectory(recording_path)

    camera = recording.intrinsics
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == K
    assert [frame.time_ns for frame in recording] == STAMPS
    for frame in recording:
        np.testing.assert_array_equal(frame.depth_m, (DEPTH / 1000).astype(np.float32))
    assert not recording.damage
    assert trajectory is not None
    np.testing.assert_array_equal(trajectory.times_ns, STAMPS)
    np.testing.assert_allclose(trajectory.reference_from_camera[:, 0, 3], [0, 1, 2])


def test_json_may_leave_out_what_is_empty(recording_path):
    """An undistorted, unrectified camera needs K and a size alone."""
    with Scribe(recording_path) as scribe:
        time = {"timestamp": {"sec": 3, "nsec": 5}}
        camera = {name: calibration()[name] for name in ("frame_id", "width", "height", "K")}
        scribe.json("/c/calibration", "foxglove.CameraCalibration", {**time, **camera}, 1)
        scribe.json("/c/depth", "foxglove.RawImage", {**time, **raw_image()}, 1)
    recording = open_recording(recording_path)
    assert recording.intrinsics.fx == K[0]
    assert [frame.time_ns for frame in recording] == [3_000_000_005]


@pytest.mark.parametrize(
    ("spelling", "name"),
    [
        ("sensor_msgs/msg/Image", "sensor_msgs/msg/Image"),
        ("sensor_msgs/Image", "sensor_msgs/msg/Image"),
        ("sensor_msgs::msg::dds_::Image_", "sensor_msgs/msg/Image"),
        ("tf/tfMessage", "tf2_msgs/msg/TFMessage"),
        ("foxglove.RawImage", "foxglove.RawImage"),
        ("std_srvs/srv/Empty", "std_srvs/srv/Empty"),
        ("", ""),
    ],
)
def test_schema_names_have_one_spelling(spelling, name):
    """The spellings of recorders all mean the type of ROS 2; other names stay."""
    assert canonical_name(spelling) == name


def test_unknown_schemas_are_passed_over(recording_path):
    """Topics of unknown types and encodings, malformed schemas too, do not disturb the depth."""
    with Scribe(recording_path) as scribe:
        scribe.raw("/a", ("some/msg/Thing", "ros2msg", b"int32 x"), "cdr", b"\0\1\0\0abcd", 1)
        scribe.raw("/b", ("sensor_msgs/msg/Image", "ros2msg", b"\xff\xfe no definition"), "cdr", b"xx", 2)
        scribe.raw("/c", ("foxglove.RawImage", "protobuf", b"\xff\xff\xff"), "protobuf", b"\xff", 3)
        scribe.raw("/d", ("foxglove.RawImage", "flatbuffer", b""), "flatbuffer", b"\0", 4)
        scribe.raw("/e", ("foxglove.RawImage", "jsonschema", b"{}"), "json", b"[" * 100_000, 5)
        scribe.raw("/f", ("sensor_msgs/msg/Image", "ros2msg", b""), "cdr", b"\0\1\0\0" + b"\xff" * 40, 6)
        scribe.ros2("/camera_info", camera_info(STAMPS[0], (40, 30), K), STAMPS[0])
        scribe.ros2("/depth", image(STAMPS[0], "16UC1", DEPTH), STAMPS[0])
    assert len(open_recording(recording_path)) == 1


def test_a_broken_definition_is_an_error_and_prints_nothing(capfd: pytest.CaptureFixture[str]):
    """The library that reads definitions would print its own line beside what it raises."""
    with pytest.raises(Exception, match="no-such"):
        decoder("sensor_msgs/msg/Image", "ros2msg", b"no-such/type/at/all stamp\n")

    assert capfd.readouterr().err == ""


def test_messages_compressed_one_by_one_are_read(recording_path):
    """rosbag2's message compression packs each message in zstd; its claims are checked."""
    import zstandard

    message = image(STAMPS[0], "16UC1", DEPTH)
    text = STORE.generate_msgdef("sensor_msgs/msg/Image", ros_version=2)[0].encode()
    packed = zstandard.compress(bytes(STORE.serialize_cdr(message, message.__msgtype__)))
    bomb = bytes.fromhex("28b52ffd e0 ffffffffffffff7f")  # claims 2^63 bytes
    with Scribe(recording_path) as scribe:
        scribe.ros2("/camera_info", camera_info(STAMPS[0], (40, 30), K), STAMPS[0])
        scribe.raw("/depth", ("sensor_msgs/msg/Image", "ros2msg", text), "cdr", packed, STAMPS[0])
        scribe.raw("/depth", ("sensor_msgs/msg/Image", "ros2msg", text), "cdr", bomb, STAMPS[1])
    recording = open_recording(recording_path)
    assert len(recording) == 1
    assert recording.damage.lost_messages == 1


def test_quaternions_and_matrices_agree(seed):
    """A rotation goes to a quaternion and back, also near a half turn."""
    rng = np.random.default_rng(seed)
    for quaternion in [*rng.normal(size=(50, 4)), *(np.eye(4) + 1e-9 * rng.normal(size=(4, 4)))]:
        matrix = rigid_matrix((1.0, 2.0, 3.0), tuple(quaternion))
        np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
        again = rigid_matrix((1.0, 2.0, 3.0), quaternion_xyzw(matrix[:3, :3]))
        np.testing.assert_allclose(again, matrix, atol=1e-12)
