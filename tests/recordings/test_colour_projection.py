"""Colour of a camera beside the depth camera is looked up where that camera saw each point, or left out."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from recordings.errors import RecordingError
from recordings.options import ReadOptions
from recordings.overview import survey
from recordings.reading import open_recording
from tests.recordings.samples import SECOND_NS, Scribe, camera_info, image, new, transform

DEPTH_K, DEPTH_SIZE = (190.0, 191.0, 118.5, 88.25), (240, 180)
COLOUR_K, COLOUR_SIZE = (310.0, 309.0, 161.0, 119.0), (320, 240)
COLOUR_LENS = np.array([0.08, -0.15, 0.001, -0.0007, 0.02])
COLOUR_PLACE_M = np.array([0.052, -0.004, 0.003])
"""Origin of the depth camera in the colour camera: a wide offset, so that much is hidden."""
XYZW = (0.012, -0.02, 0.008, 0.99970)
WALL_Z_M, BOX_Z_M = 1.6, 0.8


def rotation() -> np.ndarray:
    """The mounting's rotation, by a formula of its own."""
    x, y, z, w = np.array(XYZW) / np.linalg.norm(XYZW)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def in_box(points: np.ndarray) -> np.ndarray:
    """Whether points (N, 3) of the plane of the box's front lie on it."""
    return (np.abs(points[:, 0] - 0.02) < 0.14) & (np.abs(points[:, 1]) < 0.11)


def depth_image() -> np.ndarray:
    """A slanted wall and a box in front of it, in metres at the depth camera's pixels."""
    fx, fy, cx, cy = DEPTH_K
    v, u = np.mgrid[: DEPTH_SIZE[1], : DEPTH_SIZE[0]]
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1)
    wall = WALL_Z_M / (1 - 0.3 * rays[..., 0])
    front = in_box((rays * BOX_Z_M).reshape(-1, 3)).reshape(u.shape)
    return np.where(front, BOX_Z_M, wall)


def truth(depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the colour camera sees each depth pixel's point (H, W, 2), and whether it does."""
    fx, fy, cx, cy = DEPTH_K
    v, u = np.mgrid[: DEPTH_SIZE[1], : DEPTH_SIZE[0]]
    points = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1) * depth_m[..., None]
    seen = points @ rotation().T + COLOUR_PLACE_M
    x, y = seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2]
    k1, k2, p1, p2, k3 = COLOUR_LENS
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    bent_y = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    pixel = np.stack([COLOUR_K[0] * bent_x + COLOUR_K[2], COLOUR_K[1] * bent_y + COLOUR_K[3]], axis=-1)
    inside = ((pixel > -0.5) & (pixel < np.array(COLOUR_SIZE) - 0.5)).all(axis=-1)
    # Visible if the straight line from the colour camera's eye meets no part of the box on the way.
    eye = -rotation().T @ COLOUR_PLACE_M
    share = (BOX_Z_M - eye[2]) / (points[..., 2] - eye[2])
    crossing = eye + share[..., None] * (points - eye)
    hidden = (share < 0.999) & in_box(crossing.reshape(-1, 3)).reshape(share.shape)
    return pixel, inside & ~hidden


def write(
    path: Path,
    *,
    mounted: bool = True,
    aligned: bool = False,
    extrinsics: np.ndarray | None = None,
    slash: str = "",
) -> np.ndarray:
    """A bag with topics as a RealSense driver names them; colours tell their own pixel. Gives the depth."""
    depth_m = depth_image()
    v, u = np.mgrid[: COLOUR_SIZE[1], : COLOUR_SIZE[0]]
    colours = np.stack([u % 256, v % 256, 10 * (u // 256) + 1], axis=-1).astype(np.uint8)
    millimetres = np.round(1000 * depth_m).astype(np.uint16)
    with Scribe(path) as scribe:
        if mounted:
            moving = transform(SECOND_NS, "color_optical", "depth_optical", COLOUR_PLACE_M, XYZW)
            scribe.ros2("/tf_static", moving, SECOND_NS)
        if extrinsics is not None:
            name = "realsense2_camera_msgs/msg/Extrinsics"
            offset = new(name, rotation=extrinsics.ravel(), translation=COLOUR_PLACE_M)
            scribe.ros2("/camera/extrinsics/depth_to_color", offset, SECOND_NS)
        info = camera_info(SECOND_NS, DEPTH_SIZE, DEPTH_K, "depth_optical")
        scribe.ros2("/camera/depth/camera_info", info, SECOND_NS)
        info = camera_info(SECOND_NS, COLOUR_SIZE, COLOUR_K, "color_optical", d=COLOUR_LENS)
        scribe.ros2("/camera/color/camera_info", info, SECOND_NS)
        depth = image(SECOND_NS, "16UC1", millimetres, "depth_optical")
        scribe.ros2("/camera/depth/image_rect_raw", depth, SECOND_NS)
        if aligned:
            info = camera_info(SECOND_NS, COLOUR_SIZE, COLOUR_K, "color_optical", d=COLOUR_LENS)
            scribe.ros2("/camera/aligned_depth_to_color/camera_info", info, SECOND_NS)
            grey = image(SECOND_NS, "16UC1", np.full(v.shape, 900, np.uint16), "color_optical")
            scribe.ros2("/camera/aligned_depth_to_color/image_raw", grey, SECOND_NS)
        colour = image(SECOND_NS, "rgb8", colours, slash + "color_optical")
        scribe.ros2("/camera/color/image_raw", colour, SECOND_NS)
    return depth_m


def test_visible_points_get_the_colour_of_their_pixel_and_hidden_ones_none(recording_path):
    """Within a pixel at 95% of the visible points at least; of the hidden ones, at most 2% get any."""
    depth_m = write(recording_path)
    pixel, visible = truth(depth_m)
    (frame,) = open_recording(recording_path)
    assert frame.rgb is not None
    assert frame.rgb_known is not None
    found = np.stack([frame.rgb[..., 0] + 256.0 * (frame.rgb[..., 2] // 10), frame.rgb[..., 1]], axis=-1)
    off = np.abs(found.astype(float) - pixel).max(axis=-1)
    right = frame.rgb_known & (off <= 1.0)
    print(f"{right[visible].mean():.4f} {frame.rgb_known[~visible].mean():.4f} of {(~visible).mean():.3f}")
    assert (~visible).mean() > 0.05, "the scene hides too little to test anything"
    assert right[visible].mean() >= 0.95
    assert frame.rgb_known[~visible].mean() <= 0.02
    assert not frame.rgb[~frame.rgb_known].any()


def test_without_a_mounting_there_is_no_colour(recording_path):
    """Nobody knows where the colour camera sits: no colour, and info says so."""
    write(recording_path, mounted=False)
    (frame,) = open_recording(recording_path)
    assert frame.rgb is None
    depth = survey(recording_path, ReadOptions()).depth
    assert depth is not None
    assert depth.colour_topic is None


def test_the_drivers_extrinsics_place_the_colour_camera_as_a_mounting_does(recording_path):
    """RealSense writes the rotation column by column; what is no rotation is passed over."""
    write(recording_path)
    (mounted,) = open_recording(recording_path)
    write(recording_path, mounted=False, extrinsics=rotation().T)
    (told,) = open_recording(recording_path)
    assert told.rgb is not None
    assert mounted.rgb is not None
    np.testing.assert_array_equal(told.rgb, mounted.rgb)
    write(recording_path, mounted=False, extrinsics=2 * rotation().T)
    (frame,) = open_recording(recording_path)
    assert frame.rgb is None


def test_the_sensors_own_depth_is_taken_before_what_was_resampled_to_a_colour_camera(recording_path):
    """Raw and aligned depth: every command takes the raw one, and the survey tells of both."""
    write(recording_path, aligned=True)
    overview = survey(recording_path, ReadOptions())
    assert open_recording(recording_path).depth_topic == "/camera/depth/image_rect_raw"
    assert overview.depth is not None
    assert overview.depth.topic == "/camera/depth/image_rect_raw"
    assert [(one.topic, one.size, one.aligned) for one in overview.candidates] == [
        ("/camera/aligned_depth_to_color/image_raw", COLOUR_SIZE, True),
        ("/camera/depth/image_rect_raw", DEPTH_SIZE, False),
    ]
    chosen = ReadOptions(depth_topic="/camera/aligned_depth_to_color/image_raw")
    assert open_recording(recording_path, chosen).size == COLOUR_SIZE


def test_a_slash_before_the_name_of_the_colour_cameras_frame_changes_nothing(recording_path):
    """ROS 1 puts it there, in some messages."""
    write(recording_path, aligned=True, slash="/")
    recording = open_recording(recording_path)
    (frame,) = recording
    assert recording.depth_topic == "/camera/depth/image_rect_raw"
    assert frame.rgb is not None


@pytest.mark.parametrize(
    ("aligned", "is_copy"),
    [
        ("/left/aligned_depth_to_color/image_raw", True),
        ("/left/depth/registered/image", True),
        ("/right/aligned_depth_to_color/image_raw", False),
    ],
)
def test_aligned_depth_of_another_device_is_no_copy(aligned, is_copy, recording_path):
    """Two cameras, one of which was recorded aligned to its colour alone: the user has to choose."""
    colour = np.zeros((6, 8, 3), np.uint8)
    with Scribe(recording_path) as scribe:
        for topic, frame in {"/left/depth/image_raw": "left", aligned: "colour"}.items():
            scribe.ros2(topic, image(SECOND_NS, "16UC1", np.full((6, 8), 900, np.uint16), frame), SECOND_NS)
        scribe.ros2("/any/color/image_raw", image(SECOND_NS, "rgb8", colour, "colour"), SECOND_NS)
    options = ReadOptions(intrinsics=(9.0, 9.0, 3.5, 2.5))
    if is_copy:
        assert open_recording(recording_path, options).depth_topic == "/left/depth/image_raw"
    else:
        with pytest.raises(RecordingError, match=r"2 depth topics.*choose with --depth-topic"):
            open_recording(recording_path, options)


@pytest.mark.parametrize("aligned", [False, True])
def test_a_copy_in_another_transport_is_no_second_camera(aligned, recording_path):
    """image_raw and image_raw/compressedDepth show the same: the plain one is taken without a question."""
    with Scribe(recording_path) as scribe:
        scribe.ros2("/d/camera_info", camera_info(SECOND_NS, (8, 6), (9.0, 9.0, 3.5, 2.5)), SECOND_NS)
        for topic in ("/d/image_raw", "/d/image_raw/zstd"):
            scribe.ros2(topic, image(SECOND_NS, "16UC1", np.full((6, 8), 900, np.uint16)), SECOND_NS)
        if aligned:
            scribe.ros2("/d/other", image(SECOND_NS, "16UC1", np.full((6, 8), 900, np.uint16)), SECOND_NS)
    if aligned:
        overview = survey(recording_path, ReadOptions())
        assert overview.depth is None
        assert len(overview.candidates) == 3
    else:
        assert open_recording(recording_path).depth_topic == "/d/image_raw"


def test_a_depth_topic_that_is_not_wanted_stops_no_survey(recording_path, tmp_path):
    """A mask of the wanted topic's size says nothing of the other, which is told where it cannot be used."""
    mask = tmp_path / "mask.png"
    Image.fromarray(np.full((6, 8), 255, np.uint8)).save(mask)
    options = ReadOptions(intrinsics=(9.0, 9.0, 3.5, 2.5), depth_topic="/a/depth", mask=mask)
    for fields in ({}, {"step": 2}):
        with Scribe(recording_path) as scribe:
            for topic, shape in {"/a/depth": (6, 8), "/b/depth": (12, 16)}.items():
                broken = fields if topic == "/b/depth" else {}
                depth = image(SECOND_NS, "16UC1", np.full(shape, 900, np.uint16), topic, **broken)
                scribe.ros2(topic, depth, SECOND_NS)
        overview = survey(recording_path, options)
        assert overview.depth is not None
        assert [one.topic for one in overview.candidates] == ["/a/depth", "/b/depth"][: 2 - len(fields)]
        assert len(overview.problems) == len(fields)
    assert "/b/depth: no message can be used" in overview.problems[0]
