"""Colour comes with the depth where, and only where, its pixels see the same points."""

import io

import numpy as np
import pytest
from PIL import Image

from recordings.errors import RecordingError
from recordings.options import ReadOptions
from recordings.overview import survey
from recordings.reading import open_recording
from recordings.types import Frame
from recordings.writer import RecordingWriter
from tests.recordings.samples import SECOND_NS, Scribe, camera_info, compressed_image, image

K = (35.0, 36.0, 18.5, 15.25)
DEPTH = np.full((30, 40), 1000, np.uint16)
STEP_NS = SECOND_NS // 30
STAMPS_NS = SECOND_NS, SECOND_NS + STEP_NS
"""Of two frames."""


@pytest.fixture
def rgb() -> np.ndarray:
    """A smooth 30x40 colour image, so that JPEG keeps it."""
    v, u = np.mgrid[:30, :40]
    return np.stack([4 * u, 6 * v, 255 - 3 * u], axis=-1).astype(np.uint8)


def read(path, messages, *, colour_camera: tuple | None = K, colour_frame="camera", size=(40, 30)):
    """The frame of a recording of one depth image and the given colour messages."""
    with Scribe(path) as scribe:
        scribe.ros2("/d/camera_info", camera_info(SECOND_NS, (40, 30), K), SECOND_NS)
        if colour_camera is not None:
            info = camera_info(SECOND_NS, size, colour_camera, colour_frame)
            scribe.ros2("/c/camera_info", info, SECOND_NS)
        scribe.ros2("/d/image", image(SECOND_NS, "16UC1", DEPTH), SECOND_NS)
        for message in messages:
            scribe.ros2("/c/image", message, SECOND_NS)
    (frame,) = open_recording(path)
    return frame


def write_two(path, colours, cameras=("/d/camera_info",)):
    """A recording of two depth images, each with a colour message of its stamp, and the given cameras."""
    with Scribe(path) as scribe:
        for topic in cameras:
            scribe.ros2(topic, camera_info(SECOND_NS, (40, 30), K), SECOND_NS)
        for stamp, colour in zip(STAMPS_NS, colours, strict=True):
            scribe.ros2("/d/image", image(stamp, "16UC1", DEPTH), stamp)
            scribe.ros2("/c/image", colour, stamp)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "8UC3"])
def test_raw_colours_come_as_rgb(encoding, rgb, recording_path):
    """The usual orders of channels all give the same RGB image."""
    order = [2, 1, 0] if encoding in {"bgr8", "bgra8", "8UC3"} else [0, 1, 2]
    pixels = rgb[..., order]
    if "a8" in encoding:
        pixels = np.concatenate([pixels, np.full((30, 40, 1), 7, np.uint8)], axis=-1)
    frame = read(recording_path, [image(SECOND_NS, encoding, pixels)])
    np.testing.assert_array_equal(frame.rgb, rgb)


@pytest.mark.parametrize(("encoding", "big_endian"), [("rgb16", False), ("bgr16", True), ("16UC3", False)])
def test_wide_colours_keep_their_upper_bits(encoding, big_endian, rgb, recording_path):
    """Of 16 bits the upper 8 count, in either byte order."""
    order = [0, 1, 2] if encoding == "rgb16" else [2, 1, 0]
    wide = 256 * rgb[..., order].astype(np.uint16) + 99
    pixels = np.ascontiguousarray(wide, ">u2" if big_endian else "<u2").view(np.uint8)
    frame = read(recording_path, [image(SECOND_NS, encoding, pixels, is_bigendian=int(big_endian))])
    np.testing.assert_array_equal(frame.rgb, rgb)


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_brightness_and_chroma_give_the_colour(encoding, recording_path):
    """Bars of ITU-R BT.601 at 75%: white, yellow, cyan, green, magenta, red, blue and black."""
    on = np.array([[1, 1, 1], [1, 1, 0], [0, 1, 1], [0, 1, 0], [1, 0, 1], [1, 0, 0], [0, 0, 1], [0, 0, 0]])
    yuv = [
        [180, 128, 128], [162, 44, 142], [131, 156, 44], [112, 72, 58],
        [84, 184, 198], [65, 100, 212], [35, 212, 114], [16, 128, 128],
    ]  # fmt: skip
    y, u, v = np.repeat(np.array(yuv, np.uint8), [6, 4] * 4, axis=0).T
    chroma = np.where(np.arange(40) % 2 == 0, u, v)
    pair = (chroma, y) if encoding == "yuv422" else (y, chroma)
    pixels = np.tile(np.stack(pair, axis=-1), (30, 1, 1))
    frame = read(recording_path, [image(SECOND_NS, encoding, pixels)])
    assert frame.rgb is not None
    np.testing.assert_allclose(frame.rgb[0, 2::5], 191 * on, atol=2)


def test_an_encoding_that_is_not_read_is_named(rgb, recording_path):
    """Bayer patterns want a debayer first: the frame comes without colour, and why is told."""
    message = image(SECOND_NS, "bayer_rggb8", rgb[..., :1])
    assert read(recording_path, [message]).rgb is None
    assert "/c/image has the encoding 'bayer_rggb8'" in open_recording(recording_path).colour_problem


@pytest.mark.parametrize(
    ("format_", "data"), [("webp", b"RIFFxxxxWEBP"), ("16UC1; zstd", b"\x28\xb5\x2f\xfd")]
)
def test_a_compression_that_is_not_read_is_named(format_, data, recording_path):
    """With the word that its writer has for it."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/c/image", compressed_image(SECOND_NS, format_, data), SECOND_NS)
    with pytest.raises(RecordingError, match=f"/c/image is compressed as '{format_}', which is not read"):
        open_recording(recording_path)


@pytest.mark.parametrize(
    ("schema", "encoding"), [("foxglove.CompressedVideo", "protobuf"), ("foxglove.RawImage", "flatbuffer")]
)
def test_images_of_a_type_that_is_not_read_are_named(schema, encoding, recording_path):
    """Beside depth, and where they may be the depth itself."""
    with Scribe(recording_path) as scribe:
        scribe.raw("/c/other", (schema, "", b""), encoding, b"data", SECOND_NS)
        scribe.raw("/status", ("diagnostics", "", b""), encoding, b"data", SECOND_NS)
    with pytest.raises(RecordingError, match=rf"/c/other holds {schema} \({encoding}\), which is not read"):
        open_recording(recording_path)
    with Scribe(recording_path) as scribe:
        scribe.ros2("/d/image", image(SECOND_NS, "16UC1", DEPTH), SECOND_NS)
        scribe.raw("/c/other", (schema, "", b""), encoding, b"data", SECOND_NS)
    depth = survey(recording_path, ReadOptions(intrinsics=K)).depth
    assert depth is not None
    assert f"/c/other holds {schema}" in depth.colour_problem


@pytest.mark.parametrize(("format_", "tolerance"), [("JPEG", 12), ("PNG", 0)])
def test_compressed_colours_are_decoded(format_, tolerance, rgb, recording_path):
    """JPEG within its loss, PNG exactly."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, format_, quality=95)
    frame = read(recording_path, [compressed_image(SECOND_NS, format_.lower(), buffer.getvalue())])
    assert frame.rgb is not None
    assert np.abs(frame.rgb.astype(int) - rgb).max() <= tolerance


def test_a_depth_image_is_no_colour(recording_path):
    """A PNG of 16-bit grey values is depth, though it is a PNG."""
    buffer = io.BytesIO()
    Image.fromarray(np.full((30, 40), 900, np.uint16)).save(buffer, "PNG")
    with Scribe(recording_path) as scribe:
        scribe.ros2("/c/camera_info", camera_info(SECOND_NS, (40, 30), K), SECOND_NS)
        scribe.ros2("/c/depth", compressed_image(SECOND_NS, "png", buffer.getvalue()), SECOND_NS)
    recording = open_recording(recording_path)
    assert (recording.depth_topic, recording.colour_topic) == ("/c/depth", None)


def test_only_registered_colour_is_attached(rgb, recording_path):
    """Another frame, another lens or another view is not registered; a larger image of the same view is."""
    message = image(SECOND_NS, "rgb8", rgb)
    assert read(recording_path, [message]).rgb is not None
    assert read(recording_path, [message], colour_camera=None).rgb is not None
    of_ros1 = image(SECOND_NS, "rgb8", rgb, "/camera")
    assert read(recording_path, [of_ros1], colour_frame="/camera").rgb is not None
    assert not open_recording(recording_path).colour_is_projected
    assert read(recording_path, [message], colour_camera=(40.0, 41.0, 18.5, 15.25)).rgb is None
    elsewhere = image(SECOND_NS, "rgb8", rgb, "elsewhere")
    assert read(recording_path, [elsewhere], colour_frame="elsewhere").rgb is None

    double = np.repeat(np.repeat(rgb, 2, axis=0), 2, axis=1)
    doubled = (70.0, 72.0, 37.5, 31.0)
    frame = read(recording_path, [image(SECOND_NS, "rgb8", double)], colour_camera=doubled, size=(80, 60))
    np.testing.assert_array_equal(frame.rgb, rgb)


@pytest.mark.parametrize("camera_frame", ["", "driver"])
def test_a_colour_camera_that_is_told_by_its_topic_alone_is_compared(camera_frame, rgb, recording_path):
    """RealSense's own bags name the frame 0 in all images and none in the calibrations."""
    for focal, is_registered in ((90.0, False), (K[0], True)):
        with Scribe(recording_path) as scribe:
            for name, k in {"Depth_0": K, "Color_0": (focal, *K[1:])}.items():
                info = camera_info(SECOND_NS, (40, 30), k, camera_frame)
                scribe.ros2(f"/d/{name}/camera_info", info, SECOND_NS)
            scribe.ros2("/d/Depth_0/data", image(SECOND_NS, "mono16", DEPTH, "0"), SECOND_NS)
            scribe.ros2("/d/Color_0/data", image(SECOND_NS, "rgb8", rgb, "0"), SECOND_NS)
        (frame,) = open_recording(recording_path)
        assert (frame.rgb is not None) == is_registered


def test_colour_is_paired_in_time(recording_path):
    """Each frame gets the nearest image within 20 ms, none if there is none so near."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/d/camera_info", camera_info(SECOND_NS, (40, 30), K), SECOND_NS)
        for i in range(20):
            stamp = SECOND_NS + i * STEP_NS
            scribe.ros2("/d/image", image(stamp, "16UC1", DEPTH), stamp)
            if not 5 <= i < 8:
                shade = np.full((30, 40, 3), i, np.uint8)
                scribe.ros2("/c/image", image(stamp + 9_000_000, "rgb8", shade), stamp)
    found = [None if f.rgb is None else int(f.rgb[0, 0, 0]) for f in open_recording(recording_path)]
    assert found == [None if 5 <= i < 8 else i for i in range(20)]


def test_a_damaged_colour_image_costs_the_colour_only(rgb, recording_path):
    """The frame stays, the colour image is counted as lost."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, "PNG")
    images = buffer.getvalue(), buffer.getvalue()[:60]
    write_two(
        recording_path,
        [compressed_image(stamp, "png", data) for stamp, data in zip(STAMPS_NS, images, strict=True)],
    )
    recording = open_recording(recording_path)
    assert [frame.rgb is not None for frame in recording] == [True, False]
    assert recording.damage.lost_messages == 1
    assert recording.problems[0].startswith("1 message of /c/image: is a damaged colour image")
    assert recording.undecodable == 0


@pytest.mark.parametrize(
    ("order", "damaged_s", "coloured"),
    [([0, 2, 1, 3], {}, "0123"), ([0, 1, 2, 3], {1: 2e9}, "0.23"), ([0, 1, 2, 3], {1: -5}, "0.23")],
)
def test_a_colour_stamp_that_is_wrong_or_late_costs_no_other(order, damaged_s, coloured, recording_path):
    """Images find their frames though one comes late, or its stamp is of the far future or of no time."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/camera_info", camera_info(SECOND_NS, (40, 30), K), SECOND_NS)
        for place, i in enumerate(order):
            log_ns = SECOND_NS + place * STEP_NS
            stamp = int(damaged_s.get(i, 1) * SECOND_NS) + i * STEP_NS
            scribe.ros2("/d/image", image(log_ns, "16UC1", DEPTH), log_ns)
            scribe.ros2("/c/image", image(stamp, "rgb8", np.full((30, 40, 3), i, np.uint8)), log_ns)
    recording = open_recording(recording_path)
    assert "".join("." if f.rgb is None else str(f.rgb[0, 0, 0]) for f in recording) == coloured
    told = ["1 message of /c/image: its stamp is no time of this age"] if -5 in damaged_s.values() else []
    assert recording.problems == told


def test_a_colour_image_of_another_size_is_lost_and_not_stretched(rgb, recording_path):
    """The camera that the recording tells is that of the first."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/camera_info", camera_info(SECOND_NS, (40, 30), K), SECOND_NS)
        for i, pixels in enumerate([rgb, rgb[:20, :30], rgb]):
            stamp = SECOND_NS + i * STEP_NS
            scribe.ros2("/d/image", image(stamp, "16UC1", DEPTH), stamp)
            scribe.ros2("/c/image", image(stamp, "rgb8", pixels), stamp)
    recording = open_recording(recording_path)
    assert [frame.rgb is not None for frame in recording] == [True, False, True]
    assert recording.problems == ["1 message of /c/image: is a colour image of another size than the first"]


def test_what_is_lost_of_colour_alone_is_counted_once(rgb, recording_path):
    """Its images are frames and colours at once."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/camera_info", camera_info(SECOND_NS, (40, 30), K), SECOND_NS)
        for stamp in (SECOND_NS, -SECOND_NS):
            scribe.ros2("/c/image", image(stamp, "rgb8", rgb), SECOND_NS)
    recording = open_recording(recording_path, ReadOptions(colour_alone=True))
    assert [frame.rgb is not None for frame in recording] == [True]
    assert recording.problems == ["1 message of /c/image: its stamp is no time of this age"]


@pytest.mark.parametrize("size", [0, 100])
def test_a_first_image_that_is_cut_does_not_decide(size, rgb, recording_path):
    """Those after it come with their frames; it is counted as lost itself."""
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, "JPEG", quality=95)
    images, format_ = (buffer.getvalue()[:size], buffer.getvalue()), "rgb8; jpeg compressed bgr8"
    write_two(
        recording_path,
        [compressed_image(stamp, format_, data) for stamp, data in zip(STAMPS_NS, images, strict=True)],
    )
    recording = open_recording(recording_path)
    assert [frame.rgb is not None for frame in recording] == [False, True]
    assert recording.damage.lost_messages == 1


def test_a_first_raw_image_without_pixels_does_not_decide(rgb, recording_path):
    """As a driver sends it before the camera runs; it is counted as lost itself."""
    images = rgb[:0, :0], rgb
    write_two(
        recording_path,
        [image(stamp, "rgb8", pixels) for stamp, pixels in zip(STAMPS_NS, images, strict=True)],
        cameras=("/c/camera_info", "/d/camera_info"),
    )
    recording = open_recording(recording_path)
    assert [frame.rgb is not None for frame in recording] == [False, True]
    assert recording.damage.lost_messages == 1


@pytest.mark.parametrize("format_", ["JPEG", "PNG"])
def test_infrared_images_are_no_colour(format_, rgb, recording_path):
    """Compressed grey images are passed over as raw ones are, for colour that stands behind them."""
    grey, coloured = io.BytesIO(), io.BytesIO()
    Image.fromarray(rgb[..., 0]).save(grey, format_)
    Image.fromarray(rgb).save(coloured, format_)
    with Scribe(recording_path) as scribe:
        scribe.ros2("/camera_info", camera_info(SECOND_NS, (40, 30), K), SECOND_NS)
        scribe.ros2("/d/image", image(SECOND_NS, "16UC1", DEPTH), SECOND_NS)
        for topic, data in {"/a/infrared": grey.getvalue(), "/b/colour": coloured.getvalue()}.items():
            scribe.ros2(topic, compressed_image(SECOND_NS, format_.lower(), data), SECOND_NS)
    assert open_recording(recording_path).colour_topic == "/b/colour"


def test_our_own_colour_comes_back(rgb, camera, recording_path):
    """What the writer registers, the reader attaches."""
    with RecordingWriter(recording_path, camera) as writer:
        writer.write_depth(Frame(time_ns=5, depth_m=np.ones((30, 40), np.float32), rgb=rgb))
    (frame,) = open_recording(recording_path)
    np.testing.assert_array_equal(frame.rgb, rgb)
