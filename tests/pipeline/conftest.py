"""Small recordings and values that the pipeline's tests share."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipeline.publishing.values import RunValues
from pipeline.room import view_room
from pipeline.surfaces import SceneSurface, Surfaces
from pipeline.synthesis.filming import film_object
from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig, ObjectScene
from pipeline.synthesis.writing import write_recording
from scene.result import SceneResult
from shapes.geometry.poses import poses_of
from shapes.prior import ShapePrior
from slam.result import SlamResult


@pytest.fixture(scope="session")
def filmed_mug() -> SyntheticRecording:
    """Six small views of a mug in a bare room."""
    scene = ObjectScene(
        camera=CameraConfig(width=96, height=72),
        room=RoomConfig(kind="bare"),
        path=PathConfig(frames=6, degrees_per_frame=12.0, radius_m=0.7),
    )
    return film_object("mug", built_in_object("mug"), scene, 4)


@pytest.fixture(scope="session")
def mug_file(filmed_mug: SyntheticRecording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as a file."""
    path = tmp_path_factory.mktemp("recordings") / "mug.mcap"
    write_recording(filmed_mug, path)
    return path


@pytest.fixture(scope="session")
def true_trajectory(filmed_mug: SyntheticRecording) -> SlamResult:
    """What a perfect tracker of three particles would find in it."""
    poses = filmed_mug.trajectory.reference_from_camera
    mean = np.linalg.inv(poses[0]) @ poses
    frames = len(mean)
    return SlamResult(
        times_ns=filmed_mug.trajectory.times_ns,
        draws=np.tile(poses_of(mean), (3, 1, 1)).astype(np.float32),
        log_weights=np.log([0.5, 0.3, 0.2]),
        mean=mean,
        covariance=np.tile(1e-6 * np.eye(6), (frames, 1, 1)),
        degrees_of_freedom=np.asarray(8.0),
        undiscovered=np.asarray(0.0),
        hypotheses=np.linspace(3.0, 2.0, frames),
        log_evidence=np.full(frames, 10.0),
        resampled=np.zeros(frames, bool),
        lost=np.zeros(frames, bool),
        explained=np.ones(frames),
        disparity_per_m=np.zeros((7, 9)),
        disparity_sd_per_m=np.full((7, 9), 2e-3),
        camera=np.array([640.0, 480.0, 600.0, 600.0, 319.5, 239.5]),
    )


@pytest.fixture(scope="session")
def parsed_run(true_trajectory: SlamResult) -> RunValues:
    """A mug on a box, found in the third frame, and a can that is not there."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = [[0, 0, 0.6], [0, 0, 0.7], [0, 0, 0.8]]
    aside_m = np.sqrt(3e-6) * np.concatenate([np.eye(3), -np.eye(3)])  # of second moment 1e-6 along each axis
    samples = np.zeros((6, 3, 7))
    samples[..., 0] = 1
    samples[..., 4:] = poses[None, :, :3, 3] + aside_m[:, None]
    edges = np.zeros((3, 4))
    edges[0, 1] = edges[1, 3] = 0.9
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    surface = SceneSurface(vertices_m=np.asarray(box.vertices), faces=np.asarray(box.faces, np.int64))
    scene = SceneResult(
        names=np.array(["mug", "box", "can"]),
        frames=np.array([2]),
        camera_from_object=poses,
        most_probable=poses,
        covariance=np.tile(1e-6 * np.eye(6), (3, 1, 1)),
        presence=np.array([0.99, 0.98, 0.1]),
        presence_std=np.array([0.0, 0.0, 0.002]),
        hidden_presence=np.array([0.0, 0.0, 0.1]),
        number_probabilities=np.array([[0.01, 0.99, 0, 0], [0.02, 0.98, 0, 0], [0.9, 0.1, 0, 0]]),
        hidden_share=np.array([0.0, 0.0, 0.01]),
        hidden_poses=np.tile([1.0, 0, 0, 0, 0.2, 0, 0.9], (3, 4, 1)),
        visible_fraction=np.ones(3),
        colour_nats=np.zeros(3),
        mode_poses=poses[:, None],
        mode_probabilities=np.ones((3, 1)),
        sample_modes=np.zeros((6, 3), np.int32),
        edge_probabilities=edges,
        edge_faces=np.full((3, 4, 2), -1, np.int32),
        sample_poses=samples,
        sample_parents=np.tile(np.array([1, 3, -1], np.int32), (6, 1)),
        sample_log_posteriors=np.arange(6.0),
        chain=np.zeros(6, np.int32),
        acceptance=np.array(0.5),
        log_estimate_variance=np.array(0.0),
    )
    surfaces = Surfaces(dict.fromkeys(("mug", "box", "can"), surface))
    return RunValues(slam=true_trajectory, room=None, shapes={}, surfaces=surfaces, scene=scene)


@pytest.fixture(scope="session")
def small_shape() -> ShapePrior:
    """All voxels differ; one is free, one occupied."""
    phi = np.linspace(0.1, 0.9, 24, dtype=np.float32).reshape(2, 3, 4)
    pose = np.eye(4)
    pose[:3, 3] = [0.1, 0.2, 0.3]
    free, occupied = np.zeros((2, 2, 3, 4), bool)
    free[0, 0, 0] = occupied[1, 2, 3] = True
    return ShapePrior(
        phi=phi,
        pitch_m=0.005,
        reference_from_grid=pose,
        seen_free=free,
        seen_occupied=occupied,
        enclosed=np.zeros((2, 3, 4), bool),
    )


@pytest.fixture(scope="session")
def values(filmed_mug: SyntheticRecording, true_trajectory: SlamResult, small_shape: ShapePrior) -> RunValues:
    """A run with a trajectory, a room and a shape of 2 x 3 x 4 voxels."""
    room = view_room(filmed_mug, filmed_mug.intrinsics, true_trajectory.mean)
    return RunValues(slam=true_trajectory, room=room, shapes={"mug": small_shape})
