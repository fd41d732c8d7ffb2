"""Recorded poses lead to the depth camera, whichever way the recorder wrote them."""

import logging

import numpy as np
import pytest
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

from recordings.errors import RecordingError
from recordings.options import ReadOptions
from recordings.poses.recorded import recorded_pose, recorded_trajectory
from recordings.poses.rigid import orthonormalised
from recordings.poses.track import LONGEST_GAP_NS, Track
from recordings.reading import open_recording
from tests.recordings.samples import (
    SECOND_NS,
    Scribe,
    camera_info,
    header,
    image,
    new,
    pose,
    transform,
)

K = (35.0, 36.0, 18.5, 15.25)
DEPTH = np.full((30, 40), 1000, np.uint16)
STAMPS = [2 * SECOND_NS + i * SECOND_NS // 10 for i in range(5)]
QUARTER = (0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4))
"""A quarter turn about z, xyzw."""


def write(path, messages, frame_id="camera"):
    """Five frames, and further messages as (topic, message)."""
    with Scribe(path) as scribe:
        scribe.ros2("/c/camera_info", camera_info(STAMPS[0], (40, 30), K, frame_id), STAMPS[0])
        for stamp in STAMPS:
            scribe.ros2("/c/depth", image(stamp, "16UC1", DEPTH, frame_id), stamp)
        for topic, message in messages:
            scribe.ros2(topic, message, STAMPS[0])


def odometry(stamp, frame_id, child, position):
    """A nav_msgs/msg/Odometry."""
    zero = new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = new("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    return new(
        "nav_msgs/msg/Odometry",
        header=header(stamp, frame_id),
        child_frame_id=child,
        pose=new("geometry_msgs/msg/PoseWithCovariance", pose=pose(position), covariance=np.zeros(36)),
        twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def pose_stamped(stamp, frame_id, position):
    """A geometry_msgs/msg/PoseStamped."""
    return new("geometry_msgs/msg/PoseStamped", header=header(stamp, frame_id), pose=pose(position))


def test_static_and_moving_links_are_chained(recording_path):
    """The camera's pose is map <- base (moving) <- mount (static) <- camera (static)."""
    moving = [("/tf", transform(s, "map", "base", (i, 0, 0), QUARTER)) for i, s in enumerate(STAMPS)]
    static = [
        ("/tf_static", transform(0, "base", "mount", (1, 0, 0))),
        ("/tf_static", transform(0, "/mount", "/camera", (0, 0, 2), QUARTER)),
    ]
    write(recording_path, moving + static)
    trajectory = recorded_trajectory(recording_path)

    assert trajectory is not None
    np.testing.assert_array_equal(trajectory.times_ns, STAMPS)
    half_turn = np.diag([-1.0, -1, 1])
    for i, matrix in enumerate(trajectory.reference_from_camera):
        np.testing.assert_allclose(matrix[:3, :3], half_turn, atol=1e-12)
        np.testing.assert_allclose(matrix[:3, 3], [i, 1, 2], atol=1e-12)


def test_poses_between_samples_are_interpolated(recording_path):
    """Between two samples the camera moves in a line and turns at constant speed."""
    ends = [
        ("/tf", transform(STAMPS[0], "map", "camera", (0, 0, 0))),
        ("/tf", transform(STAMPS[4], "map", "camera", (4, 0, 0), QUARTER)),
    ]
    write(recording_path, ends)
    trajectory = recorded_trajectory(recording_path)

    assert trajectory is not None
    for i, matrix in enumerate(trajectory.reference_from_camera):
        angle = i / 4 * np.pi / 2
        np.testing.assert_allclose(matrix[:2, 0], [np.cos(angle), np.sin(angle)], atol=1e-12)
        np.testing.assert_allclose(matrix[0, 3], i, atol=1e-12)


def test_gaps_are_not_bridged():
    """Across a longer gap, and well beyond the ends, a track does not answer."""
    track = Track()
    ends = np.eye(4), np.diag([1.0, -1, -1, 1])
    for time_ns, matrix in zip((0, LONGEST_GAP_NS + 2), ends, strict=True):
        track.add(time_ns, matrix)
    np.testing.assert_array_equal(track.at(0), np.eye(4))
    assert track.at(LONGEST_GAP_NS // 2) is None
    assert track.at(-SECOND_NS) is None
    assert track.at(-1) is not None


def test_a_mounting_that_is_told_anew_holds_until_the_next():
    """/tf_static is latched: nothing lies between two of its transforms, and nothing ends."""
    track, moved = Track(is_mounting=True), np.eye(4)
    moved[0, 3] = 1e-4
    track.add(SECOND_NS, np.eye(4))
    track.add(2 * SECOND_NS, moved)
    found = {time_ns: track.at(time_ns) for time_ns in (0, 2 * SECOND_NS - 1, 2 * SECOND_NS, 90 * SECOND_NS)}
    for matrix, expected in zip(found.values(), (np.eye(4), np.eye(4), moved, moved), strict=True):
        np.testing.assert_array_equal(matrix, expected)


@pytest.mark.parametrize("is_bare", [False, True])
def test_poses_at_times_that_are_none_are_passed_over(is_bare, recording_path):
    """Damage makes any number of a log time, which serves where no stamp is set."""
    kind = "PoseInFrame" if is_bare else "FrameTransform"
    with Scribe(recording_path) as scribe:
        scribe.ros2("/c/camera_info", camera_info(STAMPS[0], (40, 30), K), STAMPS[0])
        for i, stamp in enumerate(STAMPS):
            scribe.ros2("/c/depth", image(stamp, "16UC1", DEPTH), stamp)
            for seconds, log_ns, x in ((stamp // SECOND_NS, stamp, i), (0, (1 << 63) + i, 9), (-5, stamp, 9)):
                place = {"x": x, "y": 0, "z": 0}
                turn = {"x": 0, "y": 0, "z": 0, "w": 1}
                message = {
                    "timestamp": {"sec": seconds, "nsec": stamp % SECOND_NS if seconds else 0},
                    "frame_id": "map",
                    "parent_frame_id": "map",
                    "child_frame_id": "camera",
                    "translation": place,
                    "rotation": turn,
                    "pose": {"position": place, "orientation": turn},
                }
                scribe.json("/p", f"foxglove.{kind}", message, log_ns)
    trajectory = recorded_trajectory(recording_path)
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.reference_from_camera[:, 0, 3], range(5), atol=1e-12)


@pytest.mark.parametrize("kind", ["odometry", "odometry and mount", "pose stamped", "pose in frame"])
def test_other_kinds_of_poses_serve(kind, recording_path):
    """Odometry links its frames; a topic of bare poses is taken for the camera's."""
    messages = {
        "odometry": [("/o", odometry(s, "odom", "camera", (i, 0, 0))) for i, s in enumerate(STAMPS)],
        "odometry and mount": [
            *(("/o", odometry(s, "odom", "base", (i - 1, 0, 0))) for i, s in enumerate(STAMPS)),
            ("/tf_static", transform(0, "base", "camera", (1, 0, 0))),
        ],
        "pose stamped": [("/p", pose_stamped(s, "map", (i, 0, 0))) for i, s in enumerate(STAMPS)],
        "pose in frame": [],
    }[kind]
    write(recording_path, messages)
    if kind == "pose in frame":
        with Scribe(recording_path) as scribe:
            scribe.ros2("/c/camera_info", camera_info(STAMPS[0], (40, 30), K), STAMPS[0])
            for i, stamp in enumerate(STAMPS):
                scribe.ros2("/c/depth", image(stamp, "16UC1", DEPTH), stamp)
                message = PoseInFrame(frame_id="map")
                message.timestamp.FromNanoseconds(stamp)
                message.pose.position.x, message.pose.orientation.w = i, 1
                scribe.protobuf("/p", message, stamp)
    trajectory = recorded_trajectory(recording_path)

    assert trajectory is not None
    np.testing.assert_allclose(trajectory.reference_from_camera[:, 0, 3], range(5), atol=1e-12)


def test_transforms_go_before_odometry(recording_path):
    """Where /tf already places the frame, odometry of the same body is not mixed in."""
    moving = [("/tf", transform(s, "map", "camera", (i, 0, 0))) for i, s in enumerate(STAMPS)]
    other = [("/a_odom", odometry(s, "odom", "camera", (9, 9, 9))) for s in STAMPS]
    write(recording_path, other + moving)
    trajectory = recorded_trajectory(recording_path)
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.reference_from_camera[:, 0, 3], range(5), atol=1e-12)


def test_a_mounting_alone_is_no_trajectory(recording_path):
    """A driver's static frames say nothing on where the camera was."""
    write(recording_path, [("/tf_static", transform(0, "base", "camera"))])
    assert recorded_trajectory(recording_path) is None


def test_a_camera_that_stands_still_has_a_trajectory(recording_path):
    """The same transform over and over on /tf is a trajectory."""
    write(recording_path, [("/tf", transform(s, "map", "camera", (1, 2, 3))) for s in STAMPS])
    trajectory = recorded_trajectory(recording_path, ReadOptions(every=2))
    assert trajectory is not None
    np.testing.assert_array_equal(trajectory.times_ns, STAMPS[::2])


def test_a_transform_that_is_sent_once_says_nothing_on_later_frames(recording_path):
    """Where no link moves, silence on /tf is not rest; `parse` may take it for where the camera stood."""
    write(recording_path, [("/tf", transform(STAMPS[0], "map", "camera", (1, 2, 3)))])
    trajectory = recorded_trajectory(recording_path)
    assert trajectory is not None
    np.testing.assert_array_equal(trajectory.times_ns, STAMPS[:1])
    held = recorded_pose(open_recording(recording_path), STAMPS[4])
    assert held is not None
    np.testing.assert_array_equal(held[:3, 3], [1, 2, 3])


@pytest.mark.parametrize("stamps", [[0], [STAMPS[4] + SECOND_NS], STAMPS[1:4]])
def test_joints_that_never_move_hold_at_all_times_where_others_move(stamps, recording_path):
    """Robots publish fixed joints on /tf: latched once, in advance, or now and then."""
    moving = [("/tf", transform(s, "map", "base", (i, 0, 0))) for i, s in enumerate(STAMPS)]
    fixed = [("/tf", transform(stamp, "base", "camera", (0, 0, 1))) for stamp in stamps]
    write(recording_path, moving + fixed)
    trajectory = recorded_trajectory(recording_path)
    assert trajectory is not None
    expected = [(i, 0, 1) for i in range(5)]
    np.testing.assert_allclose(trajectory.reference_from_camera[:, :3, 3], expected, atol=1e-12)


def test_circles_of_frames_end(recording_path):
    """Frames that are each other's parent do not hang the reader."""
    loop = [("/tf", transform(s, "a", "camera")) for s in STAMPS]
    loop += [("/tf", transform(s, "camera", "a")) for s in STAMPS]
    write(recording_path, loop)
    assert recorded_trajectory(recording_path) is not None


def test_two_pose_topics_ask(recording_path):
    """Bare poses of two things are not guessed between; the nearer namespace decides."""
    messages = [
        (topic, pose_stamped(stamp, "map", (i, 0, 0)))
        for i, topic in enumerate(["/a/pose", "/b/pose"], 1)
        for stamp in STAMPS
    ]
    write(recording_path, messages)
    with pytest.raises(RecordingError, match=r"2 pose topics .* /a/pose, /b/pose"):
        recorded_trajectory(recording_path)
    nearer = [("/c/pose", pose_stamped(stamp, "map", (3, 0, 0))) for stamp in STAMPS]
    write(recording_path, messages + nearer)
    trajectory = recorded_trajectory(recording_path)
    assert trajectory is not None
    assert trajectory.reference_from_camera[0, 0, 3] == 3


def test_a_single_bare_pose_is_a_goal_and_no_trajectory(recording_path, caplog, monkeypatch):
    """Robots are sent to poses by the same message; that several are taken for the camera's is said."""
    monkeypatch.setattr(logging.getLogger("voxscene"), "propagate", True)
    goal = [("/goal_pose", pose_stamped(STAMPS[1], "map", (3, 1, 0)))]
    write(recording_path, goal)
    assert recorded_trajectory(recording_path) is None
    assert not caplog.messages
    write(recording_path, goal + [("/c/pose", pose_stamped(stamp, "map", (3, 0, 0))) for stamp in STAMPS])
    assert recorded_trajectory(recording_path) is not None
    assert "/c/pose, which do not name what they are of, are taken for the camera's" in caplog.text


def test_poses_of_another_clock_are_told_from_none(recording_path):
    """There are poses, but none where a frame is."""
    write(recording_path, [("/tf", transform(s + 10**12, "map", "camera", (s, 0, 0))) for s in STAMPS])
    with pytest.raises(RecordingError, match="none near the stamp of a frame"):
        recorded_trajectory(recording_path)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_transforms_that_are_none_are_left_out(number, recording_path):
    """NaN and a zero quaternion are no transforms."""
    sound = [("/tf", transform(s, "map", "camera", (i, 0, 0))) for i, s in enumerate(STAMPS)]
    broken = [
        ("/tf", transform(STAMPS[0], "map", "camera", (number, 0, 0))),
        ("/tf", transform(STAMPS[0], "map", "camera", (0, 0, 0), (0, 0, 0, 0))),
    ]
    write(recording_path, broken + sound)
    trajectory = recorded_trajectory(recording_path)
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.reference_from_camera[:, 0, 3], range(5), atol=1e-12)


@pytest.mark.parametrize("xyzw", [(0, 0, 0, 0), (0, 0, 0, np.nan)])
def test_a_transform_that_is_none_costs_itself_alone(xyzw, recording_path):
    """A gripper whose joint is not known yet stands beside the camera's in one message of /tf."""
    messages = []
    for i, stamp in enumerate(STAMPS):
        message = transform(stamp, "base", "finger", xyzw=xyzw)
        message.transforms.extend(transform(stamp, "world", "camera", (i, 0, 0)).transforms)
        messages.append(("/tf", message))
    write(recording_path, messages)
    trajectory = recorded_trajectory(recording_path)
    assert trajectory is not None
    np.testing.assert_array_equal(trajectory.reference_from_camera[:, 0, 3], range(5))


def test_orthonormalised_is_the_nearest_rotation(seed):
    """Rounded rotations become orthonormal and stay near."""
    rng = np.random.default_rng(seed)
    rotations = np.linalg.qr(rng.normal(size=(20, 3, 3)))[0]
    rotations *= np.linalg.det(rotations)[:, None, None]
    matrices = np.tile(np.eye(4), (20, 1, 1))
    matrices[:, :3, :3] = rotations
    rigid = orthonormalised(matrices.round(3))
    gram = rigid[:, :3, :3] @ np.swapaxes(rigid[:, :3, :3], 1, 2)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(rigid, matrices, atol=2e-3)


@pytest.mark.parametrize("broken", [np.diag([-1.0, 1, 1, 1]), np.full((4, 4), np.nan)])
def test_orthonormalised_refuses_what_is_no_pose(broken: np.ndarray) -> None:
    """A reflection or NaN is the caller's mistake."""
    with pytest.raises(ValueError, match="a pose is"):
        orthonormalised(broken)
