"""The camera filter on rooms whose depth is known in closed form."""

from dataclasses import fields, replace
from typing import Any

import jax
import numpy as np
import pytest

from pipeline.evaluation.trajectory_errors import trajectory_errors
from recordings.types import Frame
from slam.config import SlamConfig
from slam.filter.state import FrameInfo
from slam.keyframes.depth_view import view_of_frame
from slam.keyframes.pages import PageFile
from slam.pose_graph.overlaps import KeyframeImages
from slam.result import SlamResult
from slam.tracking import _Tracker, track
from tests.slam import box_room

CONFIG = SlamConfig(particles=16)


def _track(
    key: jax.Array, frames: list[Frame], config: SlamConfig = CONFIG
) -> tuple[SlamResult, list[FrameInfo]]:
    infos: list[FrameInfo] = []
    return track(key, frames, box_room.INTRINSICS, config, infos.append), infos


def _from_first(poses: np.ndarray) -> np.ndarray:
    return np.linalg.inv(poses[0]) @ poses


def test_noise_free_frames_return_the_truth(key):
    """With exact depth the path is found to a millimetre and a milliradian."""
    poses = box_room.walk(8)

    result, _ = _track(key, box_room.frames(poses))

    errors = trajectory_errors(result.mean, _from_first(poses))
    assert errors.ate_first_pose_m < 0.001
    assert errors.rpe_rotation_rad < 0.001


def test_returns_beyond_the_range_of_the_sensor_widen_it_wherever_keyframes_are_compared(key):
    """From the first frame on, which other keyframes are held against, and where loops are looked for."""
    (frame,) = box_room.frames(box_room.walk(1))
    far = replace(frame, depth_m=4.0 * frame.depth_m)
    tracker = _Tracker(key, CONFIG, PageFile(), None, lambda _: None)

    tracker.follow(0, far, view_of_frame(far, box_room.INTRINSICS), None, box_room.INTRINSICS)

    assert far.depth_m.max() > 10.0
    assert tracker.state is not None
    assert tracker.state.calibration.noise.max_range_m == far.depth_m.max()
    images = KeyframeImages.of(tracker.state, tracker.details, tracker.noise)
    assert images.noise.max_range_m == far.depth_m.max()


def test_a_noisy_walk_is_followed_and_told(key):
    """Millimetres with structured-light noise; every field of the result means what it says."""
    poses = box_room.walk(10)

    result, infos = _track(key, box_room.frames(poses, seed=5))

    assert trajectory_errors(result.mean, _from_first(poses)).ate_first_pose_m < 0.005
    assert len(result) == len(infos) == 10
    np.testing.assert_allclose(np.exp(result.log_weights).sum(), 1.0, rtol=1e-5)
    np.testing.assert_array_equal(result.mean[0], np.eye(4))
    assert not result.lost.any()
    assert ((result.hypotheses >= 1) & (result.hypotheses <= 16 * (1 + 1e-5))).all()
    assert (np.linalg.eigvalsh(result.covariance[1:]) > 0).all()
    likely = result.log_weights > np.log(1e-3)
    spread = np.abs(result.trajectories[likely][:, :, :3, 3] - result.mean[None, :, :3, 3]).max()
    assert spread < 0.05


def test_equal_seeds_give_equal_bytes_and_survive_saving(key, tmp_path):
    """The same key twice writes the same file, which reads back as it was."""
    frames = box_room.frames(box_room.walk(4), seed=6)
    first, second = (_track(jax.random.clone(key), frames)[0] for _ in range(2))

    first.save(tmp_path / "a.npz")
    second.save(tmp_path / "b.npz")
    loaded = SlamResult.load(tmp_path / "a.npz")

    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    np.testing.assert_array_equal(loaded.trajectories, first.trajectories)
    np.testing.assert_array_equal(loaded.lost, first.lost)


def test_blank_frames_are_lost_and_the_camera_is_found_again(key):
    """A covered lens loses the camera, says so, and later frames are placed against the whole map.

    Nothing is searched for an image of nothing.
    """
    poses = box_room.walk(9)
    frames = box_room.frames(poses, seed=7)
    for index in (4, 5):
        blank = np.zeros_like(frames[index].depth_m)
        frames[index] = Frame(time_ns=frames[index].time_ns, depth_m=blank)

    result, infos = _track(key, frames)

    assert result.lost.tolist() == [False] * 4 + [True] * 2 + [False] * 3
    assert not any(info.unexpected for info in infos[:6])
    found = ~result.lost
    errors = np.linalg.norm((result.mean - _from_first(poses))[found, :3, 3], axis=1)
    assert errors.max() < 0.01
    blind, seen = result.covariance[5, :3, :3].trace(), result.covariance[8, :3, :3].trace()
    assert blind > 100 * seen


def test_the_map_begins_with_the_first_frame_that_shows_anything(key):
    """A sensor that starts with images of nothing, or of a few stray pixels, loses those and no more."""
    poses = box_room.walk(6)
    frames = box_room.frames(poses, seed=11)
    for index, pixels in ((0, 0), (1, 20)):
        blank = np.zeros_like(frames[index].depth_m)
        blank[0, :pixels] = 1.0
        frames[index] = Frame(time_ns=frames[index].time_ns, depth_m=blank)

    result, infos = _track(key, frames)

    assert len(infos) == len(result) == 6
    assert result.lost.tolist() == [True] * 2 + [False] * 4
    assert trajectory_errors(result.mean[2:], _from_first(poses[2:])).ate_first_pose_m < 0.006
    assert result.covariance[0, :3, :3].trace() > 100 * result.covariance[5, :3, :3].trace()


def test_frames_of_several_sizes_and_gaps_in_time_are_one_recording(key):
    """A frame at another resolution and a pause of ten seconds change nothing about the path."""
    poses = box_room.walk(6)
    frames = box_room.frames(poses, seed=8)
    smaller = box_room.INTRINSICS.resized(107, 81)
    odd = box_room.frames(poses[3:4], seed=9, intrinsics=smaller)[0]
    frames[3] = Frame(time_ns=frames[3].time_ns, depth_m=odd.depth_m)
    frames[4:] = [Frame(time_ns=f.time_ns + 10**10, depth_m=f.depth_m) for f in frames[4:]]

    result, _ = _track(key, frames)

    assert trajectory_errors(result.mean, _from_first(poses)).ate_first_pose_m < 0.006
    assert not result.lost.any()


def test_kiss_icp_alone_may_propose(key):
    """With KISS-ICP as the source of candidates the filter still follows the walk."""
    poses = box_room.walk(6)

    result, _ = _track(key, box_room.frames(poses, seed=10), SlamConfig(particles=16, proposal="kiss"))

    assert trajectory_errors(result.mean, _from_first(poses)).ate_first_pose_m < 0.006


def test_nothing_depends_on_the_number_of_draws(key):
    """Four are the first four of sixteen; what is told of frames is the same."""
    frames = box_room.frames(box_room.walk(6), seed=12)

    few, _ = _track(jax.random.clone(key), frames, SlamConfig(particles=4))
    many, _ = _track(key, frames, SlamConfig(particles=16))

    np.testing.assert_allclose(few.draws, many.draws[:4], atol=1e-6)
    np.testing.assert_array_equal(few.mean, many.mean)
    np.testing.assert_array_equal(few.covariance, many.covariance)
    np.testing.assert_allclose(many.log_weights, -np.log(16))


def test_a_recording_without_frames_is_refused(key):
    """Nothing to track is the caller's mistake."""
    with pytest.raises(ValueError, match="no depth frame"):
        track(key, [], box_room.INTRINSICS, CONFIG)


@pytest.mark.parametrize(
    ("name", "value"),
    [("particles", 1), ("motion", "sideways"), ("orbit_radius_m", -1.0)],
)
def test_settings_out_of_range_are_refused(name: str, value: Any):
    """Every setting is checked when it is made."""
    with pytest.raises(ValueError, match=name):
        SlamConfig(**{name: value})


def test_a_file_of_the_format_before_is_read(key, tmp_path):
    """What is called `hypotheses` was called `ess` there; maps that were not found were not told of."""
    result, _ = _track(key, box_room.frames(box_room.walk(2), seed=13))
    arrays = {field.name: getattr(result, field.name) for field in fields(result)}
    arrays["ess"] = arrays.pop("hypotheses")
    del arrays["undiscovered"]
    np.savez(tmp_path / "before.npz", format_version=4, **arrays)
    np.savez(tmp_path / "now.npz", format_version=SlamResult.FORMAT_VERSION, **arrays)

    before = SlamResult.load(tmp_path / "before.npz")
    np.testing.assert_array_equal(before.hypotheses, result.hypotheses)
    assert before.undiscovered == 0.0
    with pytest.raises(ValueError, match="undiscovered"):
        SlamResult.load(tmp_path / "now.npz")


def test_a_file_that_is_no_result_is_refused(tmp_path):
    """A foreign archive is named in one line."""
    np.savez(tmp_path / "other.npz", a=np.zeros(3))

    with pytest.raises(ValueError, match="not a SLAM result"):
        SlamResult.load(tmp_path / "other.npz")
