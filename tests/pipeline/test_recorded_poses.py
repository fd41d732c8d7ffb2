"""Poses that a recording brings, where they do not fit its frames."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from pipeline.cli import voxscene
from pipeline.errors import PipelineError
from pipeline.evaluation.trajectories import compared, is_trajectory_file, reference_trajectory
from pipeline.synthesis.recording import SyntheticRecording
from recordings.messages.types import quaternion_xyzw
from recordings.options import ReadOptions
from shapes.prior import ShapePrior
from tests.recordings.samples import SECOND_NS, Scribe, camera_info, image, transform


def write(
    film: SyntheticRecording,
    path: Path,
    poses: Mapping[int, np.ndarray],
    *,
    damaged: int | None = None,
    missing: int | None = None,
) -> Path:
    """The frames of a film but one, those of these numbers with a pose on /tf; one of them is cut off."""
    camera = film.intrinsics
    size, k = (camera.width, camera.height), (camera.fx, camera.fy, camera.cx, camera.cy)
    with Scribe(path) as scribe:
        for number, frame in enumerate(film):
            stamp = frame.time_ns + SECOND_NS
            if (pose := poses.get(number)) is not None:
                turn = quaternion_xyzw(pose[:3, :3])
                scribe.ros2("/tf", transform(stamp, "map", "camera", pose[:3, 3], turn), stamp)
            if number == missing:
                continue
            cut: dict[str, Any] = {"data": np.ones(7, np.uint8)} if number == damaged else {}
            scribe.ros2("/c/camera_info", camera_info(stamp, size, k), stamp)
            scribe.ros2("/c/depth", image(stamp, "32FC1", frame.depth_m, **cut), stamp)
    return path


def learn(recording: Path, tmp_path: Path, *arguments: str) -> Result:
    """By the recording's own poses."""
    command = ["learn", str(recording), "--name", "mug", "--poses", "recorded", *arguments]
    return CliRunner().invoke(voxscene, [*command, "-o", str(tmp_path / "run")])


@pytest.mark.parametrize("count", [1, 6])
def test_a_camera_that_never_moved_teaches_no_shape(
    count: int, filmed_mug: SyntheticRecording, tmp_path: Path
) -> None:
    """A mounting on /tf, once or at every frame, is no path: the line says what to do."""
    path = write(filmed_mug, tmp_path / "rest.mcap", dict.fromkeys(range(count), np.eye(4)))
    result = learn(path, tmp_path)
    assert result.exit_code == 1, result.output
    assert "the camera never moved" in result.stderr
    assert "without --poses recorded slam finds the camera" in result.stderr


def test_eval_counts_no_frame_without_a_pose_near_in_time(
    filmed_mug: SyntheticRecording,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One pose is none for the frames after it; a camera at rest is judged, with a warning."""
    monkeypatch.setattr(logging.getLogger("voxscene"), "propagate", True)
    times_ns = filmed_mug.trajectory.times_ns + SECOND_NS
    once = reference_trajectory(write(filmed_mug, tmp_path / "once.mcap", {0: np.eye(4)}), ReadOptions())
    with pytest.raises(PipelineError, match="fewer than two frames have a reference pose"):
        compared(times_ns, once)
    assert not caplog.messages
    rest = reference_trajectory(
        write(filmed_mug, tmp_path / "rest.mcap", dict.fromkeys(range(6), np.eye(4))), ReadOptions()
    )
    assert len(compared(times_ns, rest)[0]) == 6
    assert "the camera never moved" in caplog.text


def test_a_frame_that_cannot_be_decoded_is_lost_and_the_shape_learned(
    filmed_mug: SyntheticRecording, tmp_path: Path
) -> None:
    """The shape is that of a recording without it: every other frame keeps its own pose."""
    poses, shapes = dict(enumerate(filmed_mug.trajectory.reference_from_camera)), []
    for kind, code in (("damaged", 3), ("missing", 0)):
        path = write(filmed_mug, tmp_path / f"{kind}.mcap", poses, **{kind: 2})
        result = learn(path, tmp_path / kind)
        assert result.exit_code == code, result.output
        assert ("at least 1 message lost" in result.stderr) == (code == 3)
        shapes.append(ShapePrior.load(tmp_path / kind / "run" / "shapes" / "mug.npz"))
    np.testing.assert_array_equal(shapes[0].phi, shapes[1].phi)


@pytest.mark.parametrize("place", [("--box", "-0.1,-0.1,0.6,0.1,0.1,0.8"), ("--pixel", "48,36"), ()])
def test_a_place_in_a_later_frame_than_the_first_is_told(
    place: tuple[str, ...], filmed_mug: SyntheticRecording, tmp_path: Path
) -> None:
    """The first frame with a pose is named, where a user pointed at something in it."""
    poses = dict(enumerate(filmed_mug.trajectory.reference_from_camera))
    stamp_s = 1 + filmed_mug.trajectory.times_ns[2] / SECOND_NS
    later = {number: poses[number] for number in range(2, 6)}
    for name, told, warned in (("later", later, bool(place)), ("all", poses, False)):
        path = write(filmed_mug, tmp_path / f"{name}.mcap", told)
        result = learn(path, tmp_path / name, *place, "--preview", str(tmp_path / "region.png"))
        assert result.exit_code == 0, result.output
        assert (f"is told in frame 2, at {stamp_s:.9f} s" in result.stderr) == warned


def test_the_frame_of_a_place_is_numbered_as_slam_numbers_it(
    filmed_mug: SyntheticRecording, tmp_path: Path
) -> None:
    """A frame that cannot be decoded has no number."""
    poses = dict(enumerate(filmed_mug.trajectory.reference_from_camera))
    later = {number: poses[number] for number in range(2, 6)}
    path = write(filmed_mug, tmp_path / "damaged.mcap", later, damaged=0)
    result = learn(path, tmp_path / "learnt", "--pixel", "48,36", "--preview", str(tmp_path / "region.png"))
    assert result.exit_code == 3, result.output
    stamp_s = 1 + filmed_mug.trajectory.times_ns[2] / SECOND_NS
    assert f"--pixel is told in frame 1, at {stamp_s:.9f} s" in result.stderr


@pytest.mark.parametrize(
    ("name", "start", "is_one"),
    [
        ("their.tum", b"# timestamp tx ty tz qx qy qz qw\n", True),
        ("truth", b"1.0 0 0 0 0 0 0 1\n", True),
        ("kitchen.mcap", b"damaged", False),
        ("KITCHEN.MCAP", b"\x89MCAP0\r\n", False),
        ("kitchen.bag", b"#ROSBAG V2.0\n", False),
        ("kitchen_0.db3", b"SQLite format 3\x00", False),
    ],
)
def test_recordings_are_no_trajectory_files(name: str, start: bytes, is_one: bool, tmp_path: Path) -> None:
    """Of another program neither: how to convert them is told where they are opened."""
    (tmp_path / name).write_bytes(start)
    assert is_trajectory_file(tmp_path / name) == is_one
    assert not is_trajectory_file(tmp_path)
