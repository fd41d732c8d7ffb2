"""Point clouds serve as depth where a recording has no depth image."""

import numpy as np
import pytest
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from recordings.errors import RecordingError
from recordings.options import ReadOptions
from recordings.poses.recorded import recorded_trajectory
from recordings.reading import open_recording
from tests.recordings.samples import SECOND_NS, Scribe, camera_info, header, image, new, transform

K = (35.0, 36.0, 18.5, 15.25)
STAMP = 3 * SECOND_NS


@pytest.fixture
def depth_m() -> np.ndarray:
    """A slanted wall with a hole, 30x40."""
    v, u = np.mgrid[:30, :40]
    depth = (2 + 0.01 * u + 0.02 * v).astype(np.float32)
    depth[10:14, 20:25] = 0
    return depth


def points_of(depth_m: np.ndarray) -> np.ndarray:
    """Points (30, 40, 3) in the optical frame, NaN where there is no return."""
    v, u = np.mgrid[:30, :40]
    fx, fy, cx, cy = K
    points = np.stack([(u - cx) / fx * depth_m, (v - cy) / fy * depth_m, depth_m], axis=-1)
    return np.where(depth_m[..., None] > 0, points, np.nan)


def cloud(points: np.ndarray, frame_id="lens_optical", *, dtype="<f4", padding=4, row_padding=0):
    """A sensor_msgs/msg/PointCloud2 with padding in points and rows; (H, W, 3) or (N, 3) points."""
    rows = points[None] if points.ndim == 2 else points
    height, width = rows.shape[:2]
    size = np.dtype(dtype).itemsize
    step = 3 * size + padding
    packed = np.zeros((height, width * step + row_padding), np.uint8)
    for axis in range(3):
        column = (
            np.ascontiguousarray(rows[..., axis].astype(dtype)).view(np.uint8).reshape(height, width, size)
        )
        for byte in range(size):
            packed[:, axis * size + byte : width * step : step] = column[..., byte]
    datatype = {"<f4": 7, ">f4": 7, "<f8": 8}[dtype]
    fields = [
        new("sensor_msgs/msg/PointField", name=name, offset=i * size, datatype=datatype, count=1)
        for i, name in enumerate("xyz")
    ]
    return new(
        "sensor_msgs/msg/PointCloud2",
        header=header(STAMP, frame_id),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=dtype.startswith(">"),
        point_step=step,
        row_step=packed.shape[1],
        data=packed.ravel(),
        is_dense=False,
    )


def write(path, message, **others):
    """A recording of one cloud and further messages by topic."""
    with Scribe(path) as scribe:
        scribe.ros2("/points", message, STAMP)
        for topic, other in others.items():
            scribe.ros2(f"/{topic}", other, STAMP)


@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8"])
def test_an_organised_cloud_is_its_sensors_image(dtype, depth_m, recording_path):
    """Rows and columns become pixels; the camera follows from the points themselves."""
    write(recording_path, cloud(points_of(depth_m), dtype=dtype, row_padding=12))
    recording = open_recording(recording_path)
    (frame,) = recording

    camera = recording.intrinsics
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), K, atol=1e-3)
    np.testing.assert_array_equal(frame.depth_m, depth_m)


def test_a_cloud_is_projected_into_the_recorded_camera(depth_m, recording_path, seed):
    """Points in any order are projected into the camera of their own frame."""
    points = points_of(depth_m).reshape(-1, 3)
    points = np.random.default_rng(seed).permutation(points[np.isfinite(points).all(axis=1)])
    info = camera_info(STAMP, (40, 30), K, "lens_optical")
    write(recording_path, cloud(points), camera_info=info)
    recording = open_recording(recording_path)
    (frame,) = recording

    assert recording.camera_topic == "/camera_info"
    np.testing.assert_array_equal(frame.depth_m, depth_m)


def test_a_cloud_is_projected_into_the_given_camera(depth_m, recording_path):
    """The user's camera is used, of twice the principal point's size."""
    points = points_of(depth_m).reshape(-1, 3)
    write(recording_path, cloud(points[np.isfinite(points).all(axis=1)]))
    recording = open_recording(recording_path, ReadOptions(intrinsics=(35.0, 36.0, 19.5, 14.5)))
    (frame,) = recording
    assert frame.depth_m.shape == (30, 40)
    assert abs(np.median(frame.depth_m[frame.depth_m > 0]) - np.median(depth_m[depth_m > 0])) < 0.05


def test_a_lidar_that_looks_along_x_gets_a_virtual_camera(recording_path, seed):
    """Body axes are turned to optical ones; the depth image shows the wall where it is."""
    rng = np.random.default_rng(seed)
    wall = np.column_stack([np.full(4000, 5.0), rng.uniform(-2, 2, 4000), rng.uniform(-1, 1, 4000)])
    with Scribe(recording_path) as scribe:
        scribe.ros2("/points", cloud(wall, "lidar"), STAMP)
        scribe.ros2("/tf", transform(STAMP, "map", "lidar", (1, 2, 3)), STAMP)
    recording = open_recording(recording_path)
    (frame,) = recording
    camera = recording.intrinsics

    seen = frame.depth_m > 0
    np.testing.assert_allclose(frame.depth_m[seen], 5.0, rtol=1e-6)
    assert seen.mean() > 0.7
    # u grows to the right (-y), v downwards (-z)
    assert camera.width / camera.height == pytest.approx(2.0, rel=0.1)
    trajectory = recorded_trajectory(recording_path)
    assert trajectory is not None
    expected = np.array([[0, 0, 1, 1], [-1, 0, 0, 2], [0, -1, 0, 3], [0, 0, 0, 1.0]])
    np.testing.assert_allclose(trajectory.reference_from_camera[0], expected, atol=1e-12)


def test_the_nearest_point_of_a_pixel_counts(recording_path):
    """Where two points fall on one pixel, the nearer one is seen."""
    points = np.array([[0, 0, 2.0], [0, 0, 1.0], [0, 0, 3.0], [0.5, 0.5, 1.5]])
    write(recording_path, cloud(points))
    (frame,) = open_recording(recording_path, ReadOptions(intrinsics=(10.0, 10.0, 9.5, 9.5)))
    assert np.isin(np.float32(1.0), frame.depth_m)
    assert not np.isin(np.float32(2.0), frame.depth_m)


def test_foxglove_clouds_have_a_pose_of_their_own(depth_m, recording_path):
    """A foxglove.PointCloud is moved into its frame before it is projected."""
    points = points_of(depth_m).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)].astype("<f4")
    message = PointCloud(
        frame_id="lens_optical", point_stride=12, data=(points - [0, 0, 1]).astype("<f4").tobytes()
    )
    message.timestamp.FromNanoseconds(STAMP)
    message.pose.position.z = 1.0
    message.pose.orientation.w = 1.0
    for i, name in enumerate("xyz"):
        message.fields.add(name=name, offset=4 * i, type=PackedElementField.FLOAT32)
    with Scribe(recording_path) as scribe:
        scribe.protobuf("/points", message, STAMP)
        scribe.ros2("/camera_info", camera_info(STAMP, (40, 30), K, "lens_optical"), STAMP)
    (frame,) = open_recording(recording_path)
    np.testing.assert_allclose(frame.depth_m, depth_m, atol=1e-5)


def test_a_depth_image_goes_before_a_cloud(depth_m, recording_path):
    """Clouds are read only where there is no depth image, or on request."""
    depth = image(STAMP, "32FC1", depth_m, "lens_optical")
    info = camera_info(STAMP, (40, 30), K, "lens_optical")
    write(recording_path, cloud(points_of(depth_m)), depth=depth, camera_info=info)
    assert open_recording(recording_path).depth_topic == "/depth"
    assert open_recording(recording_path, ReadOptions(depth_topic="/points")).depth_topic == "/points"


def test_fields_of_unknown_types_are_passed_over(depth_m, recording_path):
    """Drivers add their own; only x, y and z need be known."""
    message = cloud(points_of(depth_m))
    for name, datatype in [("ring", 0), ("tag", 255)]:
        message.fields.insert(
            0, new("sensor_msgs/msg/PointField", name=name, offset=12, datatype=datatype, count=4)
        )
    write(recording_path, message)
    (frame,) = open_recording(recording_path)
    np.testing.assert_array_equal(frame.depth_m, depth_m)


@pytest.mark.parametrize("broken", ["no z", "too long", "huge", "empty"])
def test_malformed_clouds_are_one_clear_line(broken, depth_m, recording_path):
    """Fields that are missing or reach out of the point, sizes that the data cannot hold, no points."""
    message = cloud(points_of(depth_m))
    if broken == "no z":
        message.fields.pop()
    elif broken == "too long":
        message.fields[2].offset = 14
    elif broken == "huge":
        message.height = 2**31
    else:
        message = cloud(np.full((5, 3), np.nan))
    write(recording_path, message)
    with pytest.raises(RecordingError, match=r"/points: "):
        open_recording(recording_path)


def test_a_cloud_in_millimetres_is_told_and_scaled(depth_m, recording_path):
    """The warning says which scale to give, and with it the depths are those of metres."""
    points = points_of(depth_m).reshape(-1, 3)
    write(recording_path, cloud(1000 * points), camera_info=camera_info(STAMP, (40, 30), K, "lens_optical"))
    unscaled = open_recording(recording_path)
    assert any("--depth-scale 0.001" in one for one in unscaled.statistics().warnings((40, 30), None))
    recording = open_recording(recording_path, ReadOptions(depth_scale_m=0.001))
    (frame,) = recording
    np.testing.assert_allclose(frame.depth_m, depth_m, rtol=1e-6)
    assert not any("--depth-scale" in one for one in recording.statistics().warnings((40, 30), None))


def test_a_lidar_that_looks_all_round_is_told(recording_path):
    """One camera sees what is in front; the share is that of the points."""
    azimuth, height = np.meshgrid(np.linspace(-np.pi, np.pi, 360, endpoint=False), np.linspace(-1, 1, 16))
    points = np.stack([3 * np.cos(azimuth), 3 * np.sin(azimuth), height], axis=-1).reshape(-1, 3)
    write(recording_path, cloud(points, "velodyne"))
    told = open_recording(recording_path).statistics().warnings((90, 90), None)
    assert any("only 31% of the first cloud" in one and "lidar" in one for one in told)


def test_a_cloud_in_the_frame_of_two_cameras_has_one_of_its_own(depth_m, recording_path):
    """Nobody knows which of the two is meant: points are projected as where none is recorded."""
    points = points_of(depth_m).reshape(-1, 3)
    others = {
        f"{name}/camera_info": camera_info(STAMP, (40, 30), (focal, *K[1:]), "lens_optical")
        for name, focal in {"left": 35.0, "right": 70.0}.items()
    }
    write(recording_path, cloud(points), **others)
    recording = open_recording(recording_path)
    assert recording.camera_topic is None
    assert len(list(recording)) == 1


@pytest.mark.parametrize(("frame_id", "told"), [("map", True), ("base", False), ("lidar", False)])
def test_clouds_in_a_frame_in_which_others_move_are_told(frame_id, told, depth_m, recording_path):
    """Registered clouds do not show what a sensor saw from where it was."""
    points = points_of(depth_m).reshape(-1, 3)
    with Scribe(recording_path) as scribe:
        scribe.ros2("/points", cloud(points, frame_id), STAMP)
        scribe.ros2("/tf_static", transform(STAMP, "base", "lidar", (0, 0, 1)), STAMP)
        for i in range(3):
            scribe.ros2("/tf", transform(STAMP + i, "map", "base", (i, 0, 0)), STAMP + i)
    warnings = open_recording(recording_path).statistics().warnings((40, 40), None)
    assert any("'map', in which others move" in one for one in warnings) == told
