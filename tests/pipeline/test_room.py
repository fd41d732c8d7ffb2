"""The fused room lies where the room is."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast
from unittest.mock import MagicMock

import numpy as np

from pipeline.room import RoomView, _numbered, view_room
from pipeline.run_folder import Committed
from pipeline.session import Session
from pipeline.stages.room import room_stage, view_stage
from pipeline.synthesis.recording import SyntheticRecording
from recordings.reading import open_recording
from scene.result import SceneResult
from slam.result import SlamResult


def test_points_lie_on_the_surfaces_seen(filmed_mug: SyntheticRecording, true_trajectory: SlamResult) -> None:
    """Nine of ten within three standard deviations at the room's far wall, in the first camera's frame."""
    room = view_room(filmed_mug, filmed_mug.intrinsics, true_trajectory.mean)
    world_from_reference = filmed_mug.trajectory.reference_from_camera[0]
    world = room.points_m @ world_from_reference[:3, :3].T + world_from_reference[:3, 3]

    distance = filmed_mug.clearance_m(world)
    assert len(room.points_m) > 1000
    assert np.quantile(distance, 0.9) < 0.03


def test_points_kilometres_apart_are_fused_like_others(filmed_mug: SyntheticRecording) -> None:
    """As of a wrong unit: the grid of a centimetre has more cells than 64 bits number."""
    rng = np.random.default_rng(3)
    depth_m = rng.uniform(500, 60_000, (72, 96)).astype(np.float32)
    frames = [replace(filmed_mug.frame(0), depth_m=depth_m)] * 2
    room = view_room(frames, filmed_mug.intrinsics, np.tile(np.eye(4), (2, 1, 1)))

    assert len(room.points_m) == depth_m.size
    cell = rng.integers(0, 4, (200, 3))
    number, counts = _numbered(cell)
    _, expected, expected_counts = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    np.testing.assert_array_equal(number, expected.ravel())
    np.testing.assert_array_equal(counts, expected_counts)


def test_views_are_thinned_frames(filmed_mug: SyntheticRecording, true_trajectory: SlamResult) -> None:
    """With their colour, in millimetres."""
    room = view_room(filmed_mug, filmed_mug.intrinsics, true_trajectory.mean)

    assert room.frames.tolist() == list(range(6))
    np.testing.assert_allclose(room.depth_mm[2] / 1000, filmed_mug.frame(2).depth_m, atol=5e-4)
    assert room.view_rgb is not None
    np.testing.assert_array_equal(room.view_rgb[2], filmed_mug.frame(2).rgb)


def test_nothing_is_fused_where_a_lost_frame_is_guessed_to_be(
    mug_file: Path, true_trajectory: SlamResult
) -> None:
    """Its image stays a view; where every frame is lost there is no cloud."""
    elsewhere = true_trajectory.mean.copy()
    elsewhere[3, :3, 3] += 50.0
    lost = np.arange(6) == 3
    session = SimpleNamespace(
        common=MagicMock(),
        recording=open_recording(mug_file),
        stage=lambda name, load, compute, *_, **__: compute(),  # noqa: ARG005
    )

    def fused(result: SlamResult) -> RoomView:
        committed = room_stage(cast(Session, session), cast(Committed[SlamResult], MagicMock(value=result)))
        return cast(RoomView, committed)  # this session commits nothing

    room = fused(replace(true_trajectory, mean=elsewhere, lost=lost))
    assert room.frames.tolist() == list(range(6))
    assert len(room.points_m) > 1000
    assert np.abs(room.points_m).max() < 20
    assert len(fused(replace(true_trajectory, lost=np.ones(6, np.bool_))).points_m) == 0


def test_saved_and_loaded_is_the_same(
    filmed_mug: SyntheticRecording, true_trajectory: SlamResult, tmp_path: Path
) -> None:
    """Every field."""
    room = view_room(filmed_mug, filmed_mug.intrinsics, true_trajectory.mean)
    room.save(tmp_path / "room.npz")
    loaded = RoomView.load(tmp_path / "room.npz")

    for name, value in vars(room).items():
        np.testing.assert_array_equal(getattr(loaded, name), value)


def test_a_view_has_the_number_of_the_frame_that_was_parsed(mug_file: Path) -> None:
    """Of a run without a trajectory: by it the run knows its stamp."""
    session = SimpleNamespace(
        recording=open_recording(mug_file),
        stage=lambda name, load, compute, *_, **__: compute(),  # noqa: ARG005
    )
    scene = SimpleNamespace(value=SimpleNamespace(frames=np.array([3])))
    committed = view_stage(cast(Session, session), cast(Committed[SceneResult], scene))

    room = cast(RoomView, committed)  # this session commits nothing
    assert room.frames.tolist() == [3]
    assert len(room.depth_mm) == 1
