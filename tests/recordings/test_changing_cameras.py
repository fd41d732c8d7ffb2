"""A camera that changes within a recording: each frame is used by its own calibration, or told as lost."""

import numpy as np
import pytest
from PIL import Image

from recordings.errors import RecordingError
from recordings.options import ReadOptions
from recordings.reading import open_recording
from recordings.types import NO_RETURN
from tests.recordings.samples import SECOND_NS, Scribe, camera_info, image

SIZE = (80, 60)
FIRST = (70.0, 72.0, 39.0, 30.0)
TOPIC = "/camera/depth/image_raw"


def plane_mm(intrinsics: tuple[float, float, float, float]) -> np.ndarray:
    """What a pinhole camera sees of the slanted plane z = 2 + x/2 (metres)."""
    fx, _, cx, _ = intrinsics
    slope = (np.arange(SIZE[0]) - cx) / fx
    return np.tile(np.rint(2000 / (1 - 0.5 * slope)), (SIZE[1], 1)).astype(np.uint16)


def written(path, cameras, **fields):
    """A recording of the plane, one frame for each camera; opened."""
    with Scribe(path) as scribe:
        for number, intrinsics in enumerate(cameras):
            stamp = (number + 1) * SECOND_NS
            scribe.ros2("/camera/depth/camera_info", camera_info(stamp, SIZE, intrinsics, **fields), stamp)
            scribe.ros2(TOPIC, image(stamp, "16UC1", plane_mm(intrinsics)), stamp)
    return open_recording(path)


@pytest.mark.parametrize("zoom", [2.0, 1.03, 0.5])
def test_frames_of_another_zoom_are_brought_to_the_first_camera(recording_path, zoom):
    """Every pixel that is left shows the plane as the first camera would; the change is told."""
    other = (FIRST[0] * zoom, FIRST[1] * zoom, FIRST[2], FIRST[3])
    recording = written(recording_path, [FIRST, FIRST, other, FIRST])
    frames = [frame.depth_m for frame in recording]
    seen = frames[2] != NO_RETURN

    assert seen.mean() > 0.9 / max(zoom, 1.0) ** 2
    # The nearest stored pixel is half a pixel off at most, where the plane is steepest.
    steepest_m = np.abs(np.diff(frames[0], axis=1)).max() / min(zoom, 1.0)
    assert np.abs(frames[2] - frames[0])[seen].max() <= 0.5 * steepest_m + 0.001
    np.testing.assert_array_equal(frames[3], frames[0])
    found = recording.statistics()
    assert list(found.camera_changes) == [1.5, 2.5]
    told = found.warnings(SIZE, recording.intrinsics)
    assert any("calibration changes 2 times, at 1.500, 2.500 s" in one for one in told)


def test_a_calibration_of_the_same_frame_with_the_slash_of_ros_1_is_followed(recording_path):
    """The slash is no part of the name."""
    wide = (FIRST[0] / 2, FIRST[1] / 2, *FIRST[2:])
    with Scribe(recording_path) as scribe:
        for number, (intrinsics, frame) in enumerate([(FIRST, "camera"), (wide, "/camera")]):
            stamp = (number + 1) * SECOND_NS
            info = camera_info(stamp, SIZE, intrinsics, frame)
            scribe.ros2("/camera/depth/camera_info", info, stamp)
            scribe.ros2(TOPIC, image(stamp, "16UC1", plane_mm(intrinsics)), stamp)
    assert list(open_recording(recording_path).statistics().camera_changes) == [0.5]


def test_calibrations_that_are_written_late_are_in_the_order_of_their_stamps(recording_path):
    """As the images beside them: a change is one, and each frame is used by its own."""
    wide = (FIRST[0] / 2, FIRST[1] / 2, *FIRST[2:])
    with Scribe(recording_path) as scribe:
        for written_at, number in enumerate([0, 1, 3, 2, 4, 5], start=1):
            intrinsics, stamp = (FIRST if number < 3 else wide), (number + 1) * SECOND_NS
            info = camera_info(stamp, SIZE, intrinsics)
            scribe.ros2("/camera/depth/camera_info", info, written_at * SECOND_NS)
            scribe.ros2(TOPIC, image(stamp, "16UC1", plane_mm(intrinsics)), written_at * SECOND_NS)
    recording = open_recording(recording_path)
    frames = [frame.depth_m for frame in recording]

    assert list(recording.statistics().camera_changes) == [2.5]
    for frame in frames[1:3]:
        np.testing.assert_array_equal(frame, frames[0])
    assert all((frame == NO_RETURN).mean() < 0.1 for frame in frames)


def test_jitter_of_a_calibration_is_no_change(recording_path):
    """Drivers round it anew in each message."""
    recording = written(recording_path, [FIRST, tuple(value + 1e-3 for value in FIRST)])

    assert not recording.statistics().camera_changes


def test_frames_of_another_camera_on_the_same_topic_are_lost_and_told(recording_path):
    """By the frame in which they were taken."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/camera/depth/camera_info", camera_info(SECOND_NS, SIZE, FIRST, "left"), SECOND_NS)
        for number in range(6):
            stamp, frame = (number + 1) * SECOND_NS, "left" if number % 2 == 0 else "right"
            scribe.ros2(TOPIC, image(stamp, "16UC1", plane_mm(FIRST), frame), stamp)
    recording = open_recording(recording_path)

    assert len(list(recording)) == 3
    assert recording.damage.lost_messages == 3
    assert any("'right'" in problem for problem in recording.problems)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"d": np.array([0.1, np.nan, 0, 0, 0])}, "distortion is not finite"),
        ({"d": np.array([-90.0, 0, 0, 0, 0])}, "of the image"),
        (
            {"d": np.array([0.0] * 12 + [0.1, 0.0]), "distortion_model": "rational_polynomial"},
            "14 coefficients, of which 12",
        ),
        (
            {"d": np.array([0.1, 0, 0, 0, 0.1]), "distortion_model": "equidistant"},
            "5 coefficients, of which 4",
        ),
    ],
)
def test_a_distortion_that_means_nothing_is_refused(recording_path, fields, reason):
    """With what to do."""
    with pytest.raises(RecordingError, match=rf"{reason}.*--intrinsics"):
        written(recording_path, [FIRST], **fields)


@pytest.mark.parametrize("focal", [1e-300, 1.0, 1e5, 1e300, np.inf])
def test_a_focal_length_of_no_camera_is_refused(recording_path, focal):
    """It is held against the image's width."""
    with Scribe(recording_path) as scribe:
        info = camera_info(SECOND_NS, SIZE, (focal, focal, 39.0, 30.0))
        scribe.ros2("/camera/depth/camera_info", info, SECOND_NS)
        scribe.ros2(TOPIC, image(SECOND_NS, "16UC1", plane_mm(FIRST)), SECOND_NS)
    with pytest.raises(RecordingError, match=r"its camera is unusable.*give --intrinsics"):
        open_recording(recording_path)


@pytest.mark.parametrize("focal", [1e-300, 1e300, 1e308])
def test_numbers_of_no_camera_that_come_later_lose_their_frames_alone(recording_path, focal):
    """Told, without an overflow on the way."""
    with Scribe(recording_path) as scribe:
        for number, fx in enumerate((FIRST[0], focal)):
            stamp = (number + 1) * SECOND_NS
            scribe.ros2("/camera/depth/camera_info", camera_info(stamp, SIZE, (fx, *FIRST[1:])), stamp)
            scribe.ros2(TOPIC, image(stamp, "16UC1", plane_mm(FIRST)), stamp)
    recording = open_recording(recording_path)

    assert len(list(recording)) == 1
    assert recording.damage.lost_messages == 1


def test_a_distortion_that_is_lost_later_is_told_with_its_frames(recording_path):
    """The frames before it are used."""
    with Scribe(recording_path) as scribe:
        for number, k1 in enumerate((0.0, np.nan)):
            stamp = (number + 1) * SECOND_NS
            info = camera_info(stamp, SIZE, FIRST, d=np.array([k1, 0, 0, 0, 0]))
            scribe.ros2("/camera/depth/camera_info", info, stamp)
            scribe.ros2(TOPIC, image(stamp, "16UC1", plane_mm(FIRST)), stamp)
    recording = open_recording(recording_path)

    assert len(list(recording)) == 1
    assert recording.damage.lost_messages == 1
    assert any("distortion is not finite" in problem for problem in recording.problems)


@pytest.mark.parametrize(
    ("name", "rectified"),
    [
        *((name, True) for name in ("rect", "rectified", "image_rect", "image_rect_raw", "image_rect_color")),
        *((name, False) for name in ("image_unrectified", "image_uncorrected", "direct", "image_raw")),
    ],
)
def test_rectified_is_a_word_of_the_topics_last_part(recording_path, name, rectified):
    """P holds for rectified images, K for others."""
    p = np.array([35.0, 0, 39, 0, 0, 36, 30, 0, 0, 0, 1, 0])
    with Scribe(recording_path) as scribe:
        scribe.ros2("/camera/depth/camera_info", camera_info(SECOND_NS, SIZE, FIRST, p=p), SECOND_NS)
        scribe.ros2(f"/camera/depth/{name}", image(SECOND_NS, "16UC1", plane_mm(FIRST)), SECOND_NS)

    assert open_recording(recording_path).intrinsics.fx == (35.0 if rectified else 70.0)


def test_black_pixels_of_a_mask_count_as_no_return(recording_path, tmp_path):
    """Of every frame; a mask of another size is refused."""
    written(recording_path, [FIRST, FIRST])
    pixels = np.full(SIZE[::-1], 255, np.uint8)
    pixels[40:] = 0
    for name, mask in (("mask.png", pixels), ("small.png", pixels[::2]), ("black.png", 0 * pixels)):
        Image.fromarray(mask).save(tmp_path / name)
    frames = list(open_recording(recording_path, ReadOptions(mask=tmp_path / "mask.png")))

    assert all((frame.depth_m[40:] == NO_RETURN).all() for frame in frames)
    assert all((frame.depth_m[:40] != NO_RETURN).all() for frame in frames)
    for name, reason in (("small.png", "is 80x30, the depth is 80x60"), ("black.png", "every pixel")):
        with pytest.raises(RecordingError, match=reason):
            open_recording(recording_path, ReadOptions(mask=tmp_path / name))
