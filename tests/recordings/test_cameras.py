"""The right camera is found for the depth, and its intrinsics are those of the stored image."""

import numpy as np
import pytest

from recordings.cameras.distortion import Undistortion
from recordings.errors import RecordingError
from recordings.options import ReadOptions
from recordings.reading import open_recording
from recordings.types import NO_RETURN, CameraIntrinsics
from tests.recordings.samples import SECOND_NS, Scribe, camera_info, image, region

STAMP = SECOND_NS
DEPTH: np.ndarray = np.full((30, 40), 1000, np.uint16)


def intrinsics_of(
    path, cameras, *, topic="/camera/depth/image_raw", frame_id="camera", depth: np.ndarray = DEPTH
):
    """fx, fy, cx, cy that a recording with these camera topics has."""
    with Scribe(path) as scribe:
        for name, messages in cameras.items():
            for message in messages if isinstance(messages, list) else [messages]:
                scribe.ros2(name, message, STAMP)
        scribe.ros2(topic, image(STAMP, "16UC1", depth, frame_id), STAMP)
    camera = open_recording(path).intrinsics
    assert (camera.width, camera.height) == depth.shape[::-1]
    return camera.fx, camera.fy, camera.cx, camera.cy


RIGHT, WRONG = (35.0, 36.0, 18.5, 15.25), (99.0, 98.0, 19.0, 14.0)


@pytest.mark.parametrize(
    ("cameras", "frame_id"),
    [
        ({"/far/away": (RIGHT, "lens"), "/camera/depth/camera_info": (WRONG, "other")}, "lens"),
        ({"/camera/depth/camera_info": (RIGHT, "a"), "/camera/color/camera_info": (WRONG, "b")}, "lens"),
        ({"/camera/depth/camera_info": (RIGHT, ""), "/camera_info": (WRONG, "")}, ""),
        ({"/camera/camera_info": (RIGHT, ""), "/other/camera_info": (WRONG, "")}, ""),
        (
            {"/camera/color/camera_info": (WRONG, "lens"), "/camera/depth/camera_info": (RIGHT, "lens")},
            "lens",
        ),
    ],
)
def test_the_camera_is_found_by_frame_then_namespace(cameras, frame_id, recording_path):
    """frame_id decides; among equals, and without it, the nearest namespace."""
    messages = {name: camera_info(STAMP, (40, 30), k, frame) for name, (k, frame) in cameras.items()}
    assert intrinsics_of(recording_path, messages, frame_id=frame_id) == RIGHT


def test_equally_near_cameras_ask(recording_path):
    """Two different cameras as near as each other are not guessed between; their size may decide."""
    pair = {
        "/camera/color/camera_info": camera_info(STAMP, (40, 30), WRONG, ""),
        "/camera/infra/camera_info": camera_info(STAMP, (40, 30), RIGHT, ""),
    }
    with pytest.raises(RecordingError, match=r"could be /camera/color.* or /camera/infra.*--intrinsics"):
        intrinsics_of(recording_path, pair, frame_id="lens")
    pair["/camera/color/camera_info"] = camera_info(STAMP, (80, 60), WRONG, "")
    assert intrinsics_of(recording_path, pair, frame_id="lens") == RIGHT


@pytest.mark.parametrize(
    ("camera_topic", "topic", "frame_id", "is_own"),
    [
        ("/camera/color/camera_info", "/camera/depth/image_raw", "color", False),
        ("/front/camera_info", "/wrist/depth", "front", False),
        ("/camera/depth/camera_info", "/camera/depth/image_raw/compressedDepth", "camera_link", True),
        ("/camera/camera_info", "/camera/depth/image_raw", "camera_link", True),
        ("/depth/calibration", "/depth", "camera_link", True),
        ("/camera/color/camera_info", "/camera/depth/image_raw", "", True),
        ("/elsewhere/camera_info", "/camera/depth/image_raw", "/lens", True),
    ],
)
def test_the_calibration_of_another_camera_is_not_used(camera_topic, topic, frame_id, is_own, recording_path):
    """One of another frame is this camera's only beside the images or above them."""
    cameras = {camera_topic: camera_info(STAMP, (40, 30), RIGHT, frame_id)}
    if is_own:
        assert intrinsics_of(recording_path, cameras, topic=topic, frame_id="lens") == RIGHT
    else:
        with pytest.raises(RecordingError, match=f"of lens, is not recorded.*{camera_topic}.*--intrinsics"):
            intrinsics_of(recording_path, cameras, topic=topic, frame_id="lens")


def test_zeros_before_the_calibration_are_passed_over(recording_path):
    """A driver's first empty camera messages do not count."""
    empty = camera_info(STAMP, (40, 30), (0, 0, 0, 0))
    messages = {"/camera/depth/camera_info": [empty, empty, camera_info(STAMP, (40, 30), RIGHT)]}
    assert intrinsics_of(recording_path, messages) == RIGHT


def test_no_camera_asks_for_intrinsics(recording_path):
    """Without any camera the error says which option helps, and the option does."""
    with pytest.raises(RecordingError, match=r"calibration of its camera is recorded; give --intrinsics"):
        intrinsics_of(recording_path, {})
    camera = open_recording(recording_path, ReadOptions(intrinsics=RIGHT)).intrinsics
    assert camera == CameraIntrinsics(width=40, height=30, fx=35.0, fy=36.0, cx=18.5, cy=15.25)


@pytest.mark.parametrize(
    ("size", "fields", "stored", "expected"),
    [
        # resized: a pixel's centre moves with its area
        ((80, 60), {}, (40, 30), (35 / 2, 36 / 2, 19 / 2 - 0.5, 15.75 / 2 - 0.5)),
        ((20, 15), {}, (40, 30), (70, 72, 37.5, 31)),
        # a region of interest moves the principal point
        ((80, 60), {"roi": region(10, 20, 40, 30)}, (40, 30), (35, 36, 8.5, -4.75)),
        # binning halves the region, or the whole
        ((80, 60), {"binning_x": 2, "binning_y": 2}, (40, 30), (17.5, 18, 9, 7.375)),
        (
            (160, 120),
            {"roi": region(10, 20, 80, 60), "binning_x": 2, "binning_y": 2},
            (40, 30),
            (17.5, 18, 4, -2.625),
        ),
        ((80, 30), {"binning_x": 2, "binning_y": 1}, (40, 30), (17.5, 36, 9, 15.25)),
        # a region that the images do not show after all
        ((40, 30), {"roi": region(10, 20, 20, 10)}, (40, 30), (35, 36, 18.5, 15.25)),
    ],
)
def test_intrinsics_follow_the_stored_image(size, fields, stored, expected, recording_path):
    """Region of interest, binning and resizing rescale K with pixel centres at integers."""
    depth = np.full(stored[::-1], 1000, np.uint16)
    camera = camera_info(STAMP, size, RIGHT, **fields)
    found = intrinsics_of(recording_path, {"/camera/depth/camera_info": camera}, depth=depth)
    np.testing.assert_allclose(found, expected)


def test_another_shape_is_refused(recording_path):
    """A camera of other proportions cannot have taken the images."""
    camera = camera_info(STAMP, (64, 30), RIGHT)
    with pytest.raises(RecordingError, match=r"for images of 64x30, they are 40x30"):
        intrinsics_of(recording_path, {"/camera/depth/camera_info": camera})


def test_rectified_images_use_the_projection(recording_path):
    """A topic named image_rect is described by P, and its D is done with."""
    k = np.array([99.0, 0, 19, 0, 98, 14, 0, 0, 1])
    camera = camera_info(STAMP, (40, 30), RIGHT, k=k, d=np.array([0.1, 0, 0, 0, 0]))
    found = intrinsics_of(
        recording_path, {"/camera/depth/camera_info": camera}, topic="/camera/depth/image_rect_raw"
    )
    assert found == RIGHT


MODELS = {
    "plumb_bob": (-0.28, 0.07, 0.001, -0.002, 0.01),
    "rational_polynomial": (0.9, 0.4, 0.0004, -0.0003, 0.02, 1.2, 0.6, 0.1),
    "equidistant": (0.02, -0.01, 0.003, -0.001),
}


def distorted(model: str, c: tuple[float, ...], x: float, y: float) -> tuple[float, float]:
    """Where a ray falls, one point at a time from the formulas of OpenCV's documentation."""
    r = (x * x + y * y) ** 0.5
    if model == "equidistant":
        t = np.arctan(r)
        scale = t * (1 + c[0] * t**2 + c[1] * t**4 + c[2] * t**6 + c[3] * t**8) / r
        return x * scale, y * scale
    k4, k5, k6 = c[5:8] if len(c) == 8 else (0, 0, 0)
    numerator = 1 + c[0] * r**2 + c[1] * r**4 + c[4] * r**6
    radial = numerator / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    return (
        x * radial + 2 * c[2] * x * y + c[3] * (r**2 + 2 * x * x),
        y * radial + c[2] * (r**2 + 2 * y * y) + 2 * c[3] * x * y,
    )


@pytest.mark.parametrize("model", MODELS)
def test_undistortion_takes_the_pixel_that_the_ray_fell_on(model):
    """A depth image that numbers its pixels shows where each pixel of the result was taken from."""
    camera = CameraIntrinsics(width=80, height=60, fx=70.0, fy=71.0, cx=41.0, cy=28.5)
    numbered = (np.arange(60 * 80, dtype=np.float32) + 1).reshape(60, 80)
    result = Undistortion(camera, model, MODELS[model]).depth(numbered)

    seen = 0
    for v in range(60):
        for u in range(80):
            x, y = distorted(model, MODELS[model], (u - 41.0) / 70.0, (v - 28.5) / 71.0)
            column, row = x * 70.0 + 41.0, y * 71.0 + 28.5
            if result[v, u] == NO_RETURN:
                assert not (0 <= column <= 79 and 0 <= row <= 59)
                continue
            taken_row, taken_column = divmod(int(result[v, u]) - 1, 80)
            assert max(abs(taken_column - column), abs(taken_row - row)) <= 0.5 + 1e-9
            seen += 1
    assert seen > 0.6 * 60 * 80


def test_a_model_that_folds_back_shows_no_ghost():
    """Beyond the radius at which the polynomial turns, nothing is seen."""
    camera = CameraIntrinsics(width=101, height=101, fx=40.0, fy=40.0, cx=50.0, cy=50.0)
    ones = np.ones((101, 101), np.float32)
    result = Undistortion(camera, "plumb_bob", (-0.4, 0, 0, 0, 0)).depth(ones)
    turning = (1 / 1.2) ** 0.5  # of r (1 - 0.4 r^2)
    u, v = np.meshgrid(np.arange(101), np.arange(101))
    radius = np.hypot(u - 50, v - 50) / 40
    assert not result[radius > turning + 0.01].any()
    assert result[radius < turning - 0.01].all()


def test_unrectified_depth_is_undistorted_on_reading(recording_path):
    """D of an unrectified topic is applied; an unknown model is refused unless intrinsics are given."""
    numbered = (np.arange(30 * 40) + 1).astype(np.uint16).reshape(30, 40)
    d = np.array([-0.28, 0.07, 0.001, -0.002, 0.01])
    for model in ("plumb_bob", "magic"):
        with Scribe(recording_path) as scribe:
            camera = camera_info(STAMP, (40, 30), RIGHT, d=d, distortion_model=model)
            scribe.ros2("/depth/camera_info", camera, STAMP)
            scribe.ros2("/depth/image_raw", image(STAMP, "16UC1", numbered), STAMP)
        if model == "magic":
            with pytest.raises(RecordingError, match="distortion model 'magic', known are"):
                open_recording(recording_path)
            (raw,) = open_recording(recording_path, ReadOptions(intrinsics=RIGHT))
            np.testing.assert_array_equal(raw.depth_m, (numbered / 1000).astype(np.float32))
        else:
            recording = open_recording(recording_path)
            (frame,) = recording
            stored = (numbered / 1000).astype(np.float32)
            expected = Undistortion(recording.intrinsics, model, tuple(d)).depth(stored)
            np.testing.assert_array_equal(frame.depth_m, expected)
            assert (frame.depth_m != stored).any()
