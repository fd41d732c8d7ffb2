"""Every way of storing a depth image gives the same metres."""

import io
import struct

import numpy as np
import pytest
from PIL import Image

from recordings.errors import RecordingError
from recordings.images.depth_pixels import MetricDepth
from recordings.options import ReadOptions
from recordings.reading import open_recording
from recordings.types import NO_RETURN, Frame
from tests.recordings.samples import SECOND_NS, Scribe, camera_info, compressed_image, image, new

K = (35.0, 36.0, 18.5, 15.25)
STAMP = 5 * SECOND_NS


@pytest.fixture
def millimetres(seed: int) -> np.ndarray:
    """A 30x40 image of whole millimetres with holes, uneven in both directions."""
    rng = np.random.default_rng(seed)
    return (rng.integers(300, 4000, (30, 40)) * (rng.random((30, 40)) > 0.1)).astype(np.uint16)


def read_one(path, message, options=None, topic="/camera/depth/image_raw") -> Frame:
    """The only frame of a recording of one image message and its camera."""
    with Scribe(path) as scribe:
        scribe.ros2("/camera/depth/camera_info", camera_info(STAMP, (40, 30), K), STAMP)
        scribe.ros2(topic, message, STAMP + 7)
    (frame,) = open_recording(path, options or ReadOptions())
    return frame


def png(pixels: np.ndarray) -> bytes:
    """A PNG of 16-bit grey values."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def rvl(pixels: np.ndarray) -> bytes:
    """The RVL code of an image, written number by number as in Wilson's paper."""
    nibbles: list[int] = []

    def write(number: int) -> None:
        while True:
            nibble, number = number & 7, number >> 3
            nibbles.append(nibble | (8 if number else 0))
            if not number:
                return

    values = [int(value) for value in pixels.ravel()]
    previous = position = 0
    while position < len(values):
        start = position
        while position < len(values) and values[position] == 0:
            position += 1
        write(position - start)
        start = position
        while position < len(values) and values[position] != 0:
            position += 1
        write(position - start)
        for value in values[start:position]:
            difference = value - previous
            write(difference * 2 if difference >= 0 else -difference * 2 - 1)
            previous = value
    nibbles += [0] * (-len(nibbles) % 8)
    words = [int("".join(f"{n:x}" for n in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)]
    return struct.pack(f"<{len(words)}I", *words)


def as_stored(name: str, millimetres: np.ndarray):
    """An image message of each kind that a depth camera's driver writes."""
    metres = (millimetres / 1000).astype(np.float32)
    padded = np.zeros((30, 50), np.uint16)
    padded[:, :40] = millimetres
    wide = np.where(metres == 0, np.nan, metres).astype(np.float32)
    transport = struct.pack("<iff", 0, 0, 0)
    size = struct.pack("<II", 40, 30)
    messages = {
        "16UC1": image(STAMP, "16UC1", millimetres),
        "mono16": image(STAMP, "mono16", millimetres),
        "padded rows": image(STAMP, "16UC1", padded, width=40),
        "last row unpadded": image(
            STAMP, "16UC1", padded, width=40, data=padded.reshape(-1)[:-10].view(np.uint8)
        ),
        "big-endian": image(STAMP, "16UC1", millimetres.astype(">u2"), is_bigendian=1),
        "32FC1": image(STAMP, "32FC1", wide),
        "32FC1 big-endian": image(STAMP, "32FC1", wide.astype(">f4"), is_bigendian=1),
        "png": compressed_image(STAMP, "16UC1; png compressed ", png(millimetres)),
        "compressedDepth png": compressed_image(
            STAMP, "16UC1; compressedDepth png", transport + png(millimetres)
        ),
        "compressedDepth, codec not named": compressed_image(
            STAMP, "16UC1; compressedDepth", transport + png(millimetres)
        ),
        "compressedDepth rvl": compressed_image(
            STAMP, "16UC1; compressedDepth rvl", transport + size + rvl(millimetres)
        ),
    }
    return messages[name]


@pytest.mark.parametrize(
    "name",
    [
        "16UC1",
        "mono16",
        "padded rows",
        "last row unpadded",
        "big-endian",
        "32FC1",
        "32FC1 big-endian",
        "png",
        "compressedDepth png",
        "compressedDepth, codec not named",
        "compressedDepth rvl",
    ],
)
def test_every_encoding_gives_the_same_metres(name, millimetres, recording_path):
    """Padding, byte order and compression leave no trace; zero is no return; the stamp is the header's.

    Nor do they in the type, which other libraries than NumPy tell apart.
    """
    frame = read_one(recording_path, as_stored(name, millimetres))

    np.testing.assert_array_equal(frame.depth_m, (millimetres / 1000).astype(np.float32))
    assert frame.depth_m.data.format == "f"
    assert frame.time_ns == STAMP


@pytest.mark.parametrize("codec", ["png", "rvl"])
def test_inverse_depth_of_floats_is_undone(codec, millimetres, recording_path):
    """32FC1 compressedDepth keeps A / d + B in 16 bits; the error is half a step of that."""
    depth_m = (millimetres / 1000).astype(np.float32)
    quantisation, farthest = 100.0, 10.0
    a = quantisation * (quantisation + 1)
    b = 1 - a / farthest
    with np.errstate(divide="ignore"):
        inverse = np.where(depth_m > 0, a / depth_m + b, 0).astype(np.uint16)
    payload = png(inverse) if codec == "png" else struct.pack("<II", 40, 30) + rvl(inverse)
    message = compressed_image(
        STAMP, f"32FC1; compressedDepth {codec}", struct.pack("<iff", 0, a, b) + payload
    )
    frame = read_one(recording_path, message)

    np.testing.assert_array_equal(frame.depth_m == NO_RETURN, depth_m == 0)
    step_m = depth_m**2 / a  # |d depth / d code|
    assert (np.abs(frame.depth_m - depth_m) <= 1.01 * step_m + 1e-6).all()


@pytest.mark.parametrize("pixels", [np.zeros((30, 40)), np.full((30, 40), 65534)])
def test_rvl_of_one_long_run(pixels, recording_path):
    """Runs over the whole image, of zeros or of one value, are decoded."""
    pixels = pixels.astype(np.uint16)
    data = struct.pack("<iff", 0, 0, 0) + struct.pack("<II", 40, 30) + rvl(pixels)
    frame = read_one(recording_path, compressed_image(STAMP, "16UC1; compressedDepth rvl", data))
    np.testing.assert_array_equal(frame.depth_m, (pixels / 1000).astype(np.float32))


def test_what_measured_nothing_is_no_return():
    """Zero, negative, NaN, infinite and saturated values become `NO_RETURN`."""
    metric = MetricDepth()
    largest = np.finfo(np.float32).max
    floats = np.array([[0, -1, np.nan, np.inf, -np.inf, largest, 2.5]], np.float32)
    integers = np.array([[0, 65535, 1, 65534]], np.uint16)

    np.testing.assert_array_equal(metric(floats), np.array([[0, 0, 0, 0, 0, 0, 2.5]], np.float32))
    np.testing.assert_array_equal(metric(integers), np.array([[0, 0, 0.001, 65.534]], np.float32))


def test_limits_and_scale_are_the_users(recording_path):
    """Depths outside the limits are no return; the scale is metres for a stored 1."""
    stored = np.tile(np.array([4999, 5000, 20000, 20001], np.uint16), (30, 10))
    options = ReadOptions(depth_scale_m=0.0001, min_depth_m=0.5, max_depth_m=2.0)
    frame = read_one(recording_path, image(STAMP, "16UC1", stored), options)
    assert frame.depth_m.dtype == np.float32
    np.testing.assert_array_equal(frame.depth_m[7, :4], np.array([0, 0.5, 2.0, 0], np.float32))


@pytest.mark.parametrize("depth_m", [np.zeros((30, 40)), np.full((30, 40), np.nan)])
def test_an_empty_image_is_a_frame(depth_m, recording_path):
    """All zeros and all NaN are frames without a return, not errors."""
    frame = read_one(recording_path, image(STAMP, "32FC1", depth_m.astype(np.float32)))
    assert not frame.depth_m.any()


@pytest.mark.parametrize(
    "fields",
    [
        {"height": 2**31},
        {"width": 2**31, "step": 2**32 - 1},
        {"step": 10},
        {"height": 31},
        {"width": 0},
        {"data": np.zeros(0, np.uint8)},
    ],
)
def test_sizes_that_contradict_the_data_are_refused(fields, millimetres, recording_path):
    """An image that claims more than it has is counted as lost; nothing is allocated for it."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/camera/depth/camera_info", camera_info(STAMP, (40, 30), K), STAMP)
        scribe.ros2("/camera/depth/image_raw", image(STAMP, "16UC1", millimetres), STAMP)
        wrong = image(STAMP + 1, "16UC1", millimetres, **fields)
        scribe.ros2("/camera/depth/image_raw", wrong, STAMP + 1)
    recording = open_recording(recording_path)

    assert [frame.time_ns for frame in recording] == [STAMP]
    assert recording.damage.lost_messages == 1


@pytest.mark.parametrize(
    ("format_", "data"),
    [
        ("16UC1; compressedDepth rvl", struct.pack("<iffII", 0, 0, 0, 2**31, 2**31) + b"\0" * 64),
        ("16UC1; compressedDepth rvl", struct.pack("<iffII", 0, 0, 0, 40, 30) + b"\0" * 64),
        ("16UC1; compressedDepth rvl", struct.pack("<iffII", 0, 0, 0, 40, 30) + b"\xff" * 64),
        ("16UC1; compressedDepth png", struct.pack("<iff", 0, 0, 0) + b"\x89PNG\r\n\x1a\n"),
        ("16UC1; compressedDepth png", b"1234"),
        ("png", png(np.ones((30, 40), np.uint16))[:-40]),
        (
            "png",
            png(np.ones((30, 40), np.uint16))[:16] + b"\x7f\xff\xff\xff" * 2 + b"\x10\x00\x00\x00\x00" * 9,
        ),
    ],
)
def test_damaged_compressed_images_are_lost_not_fatal(format_, data, millimetres, recording_path):
    """A compressed image that is cut, nonsense or a bomb costs one frame."""
    sound = png(millimetres) if format_ == "png" else struct.pack("<iff", 0, 0, 0) + png(millimetres)
    with Scribe(recording_path) as scribe:
        scribe.ros2("/depth/camera_info", camera_info(STAMP, (40, 30), K), STAMP)
        scribe.ros2("/depth/compressed", compressed_image(STAMP, format_, sound), STAMP)
        scribe.ros2("/depth/compressed", compressed_image(STAMP + 1, format_, data), STAMP + 1)
    recording = open_recording(recording_path)

    assert [frame.time_ns for frame in recording] == [STAMP]
    assert recording.damage.lost_messages == 1


def test_a_useless_first_image_does_not_decide(millimetres, recording_path):
    """The size of the recording is that of the first image that holds what it claims."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/depth/camera_info", camera_info(STAMP, (40, 30), K), STAMP)
        scribe.ros2("/depth/image", image(STAMP, "16UC1", millimetres, height=2**31), STAMP)
        scribe.ros2("/depth/image", image(STAMP + 1, "16UC1", millimetres), STAMP + 1)
    recording = open_recording(recording_path)
    assert [frame.time_ns for frame in recording] == [STAMP + 1]
    assert recording.damage.lost_messages == 1


def test_images_of_the_wrong_size_throughout_are_one_clear_line(millimetres, recording_path):
    """If no image holds what it claims, the error says so and names the topic."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/depth/camera_info", camera_info(STAMP, (40, 30), K), STAMP)
        for i in range(3):
            scribe.ros2("/depth/image", image(STAMP + i, "16UC1", millimetres, step=10), STAMP + i)
    with pytest.raises(RecordingError, match=r"/depth/image: no message can be used; the first has 2400"):
        open_recording(recording_path)


@pytest.mark.parametrize(
    ("topic", "unit", "scale_m", "expected_m"),
    [
        ("/device_0/sensor_0/option/Depth Units/value", 0.0001, None, 0.0001),
        ("/device_0/sensor_0/option/Depth_Units/value", 0.00025, None, 0.00025),
        ("/device_0/sensor_0/option/Depth Units/value", 0.001, None, 0.001),
        ("/device_0/sensor_0/option/Depth Units/value", 0.0001, 0.002, 0.002),
        ("/device_0/sensor_0/option/Depth Units/value", float("nan"), None, 0.001),
        ("/device_0/sensor_0/option/Depth Units/value", 0.0, None, 0.001),
        ("/device_0/sensor_0/option/Exposure/value", 0.0001, None, 0.001),
        ("/device_0/sensor_1/option/Depth Units/value", 0.0001, None, 0.001),
    ],
)
def test_the_recorded_unit_of_depth_is_used(topic, unit, scale_m, expected_m, millimetres, recording_path):
    """Of the sensor's own option, in RealSense's bags; the user's word goes before it."""
    option = new("std_msgs/msg/Float32", data=unit)
    with Scribe(recording_path) as scribe:
        scribe.ros2(topic, option, STAMP)
        message = image(STAMP, "mono16", millimetres, "0")
        scribe.ros2("/device_0/sensor_0/Depth_0/image/data", message, STAMP)
    (frame,) = open_recording(recording_path, ReadOptions(intrinsics=K, depth_scale_m=scale_m))
    expected = millimetres / np.float32(1 / expected_m)
    np.testing.assert_array_equal(frame.depth_m, expected.astype(np.float32))


@pytest.mark.parametrize("compressed", [False, True])
def test_infrared_is_not_depth_beside_depth(compressed, millimetres, recording_path):
    """A mono16 topic counts as depth only where nothing else does, compressed or not."""
    infrared = image(STAMP, "mono16", millimetres)
    if compressed:
        infrared = compressed_image(STAMP, "mono16; png compressed ", png(millimetres))
    with Scribe(recording_path) as scribe:
        scribe.ros2("/a/camera_info", camera_info(STAMP, (40, 30), K), STAMP)
        scribe.ros2("/a/infrared", infrared, STAMP)
        scribe.ros2("/a/z", image(STAMP, "16UC1", millimetres), STAMP)
    assert open_recording(recording_path).depth_topic == "/a/z"


def test_two_depth_topics_ask_which(millimetres, recording_path):
    """The error lists both; the option decides."""
    with Scribe(recording_path) as scribe:
        for name in ("left", "right"):
            scribe.ros2(f"/{name}/camera_info", camera_info(STAMP, (40, 30), K, name), STAMP)
            scribe.ros2(f"/{name}/depth", image(STAMP, "16UC1", millimetres, name), STAMP)

    with pytest.raises(RecordingError, match=r"2 depth topics: /left/depth, /right/depth.*--depth-topic"):
        open_recording(recording_path)
    recording = open_recording(recording_path, ReadOptions(depth_topic="/right/depth"))
    assert recording.camera_topic == "/right/camera_info"
    with pytest.raises(RecordingError, match="no depth topic /up"):
        open_recording(recording_path, ReadOptions(depth_topic="/up"))


def test_no_depth_names_what_there_is(recording_path):
    """Colour alone is no depth; the error says what the topics are."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/rgb", image(STAMP, "rgb8", np.zeros((3, 4, 3), np.uint8)), STAMP)
    with pytest.raises(RecordingError, match=r"has no depth; its topics: /rgb"):
        open_recording(recording_path)


def test_one_size_per_recording(millimetres, recording_path):
    """A frame of another size than the first is lost and counted."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/depth/camera_info", camera_info(STAMP, (40, 30), K), STAMP)
        scribe.ros2("/depth/image", image(STAMP, "16UC1", millimetres), STAMP)
        scribe.ros2("/depth/image", image(STAMP + 1, "16UC1", millimetres[:, :20]), STAMP + 1)
    recording = open_recording(recording_path)
    assert len(recording) == 1
    assert recording.damage.lost_messages == 1
