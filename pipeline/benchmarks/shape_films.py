"""Objects on film for `bench shapes`: the frames, with the true poses or with those that slam found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import jax
import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.evaluation.truth import pose_in_reference
from pipeline.stages.learn import tracked_frames
from pipeline.synthesis.filming import film_object
from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig, ObjectScene
from pipeline.synthesis.sensor import DepthSensor
from recordings.types import Frame
from slam.config import SlamConfig
from slam.tracking import track

CAMERA = CameraConfig(width=640, height=480)
ROOM = RoomConfig(kind="furnished")
RINGS = (25.0, 55.0)
RADIUS_M = 0.8
PAPER_ELEVATION_DEG = 30.0
"""Of the circle under the paper's conditions, which the supplement does not state."""

Conditions = Literal["rings", "paper"]


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectFilm:
    """One object on film.

    Attributes:
        mesh: the true shape.
        recording: of it.
        frames: T, in memory.
        trajectory: (T, 4, 4) true poses in the first camera's frame.
        reference_from_mesh: (4, 4) true.
    """

    mesh: trimesh.Trimesh
    recording: SyntheticRecording
    frames: list[Frame]
    trajectory: NDArray[np.float64]
    reference_from_mesh: NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedFilm:
    """What learning gets of a film, and where the truth is in that frame.

    Attributes:
        frames: those that have a pose.
        trajectories: (K, T, 4, 4).
        log_weights: (K,).
        reference_from_mesh: (4, 4).
    """

    frames: list[Frame]
    trajectories: NDArray[np.float64]
    log_weights: NDArray[np.float64]
    reference_from_mesh: NDArray[np.float64]

    @property
    def best(self) -> NDArray[np.float64]:
        """The likeliest trajectory (T, 4, 4)."""
        return self.trajectories[int(np.argmax(self.log_weights))]


def film_of(
    mesh: trimesh.Trimesh,
    views: int,
    seed: int,
    conditions: Conditions = "rings",
    *,
    noise_free: bool = False,
) -> ObjectFilm:
    """Views of a mesh on a pedestal.

    Args:
        mesh: what is filmed.
        views: number of frames.
        seed: of room, rest and noise.
        conditions: `rings` at 25 and 55 degrees in a furnished room, or those of the supplement's section C
            (`paper`): a bare rectangular room, one circle at constant distance.
        noise_free: measure exactly.
    """
    if conditions == "rings":
        room, path = ROOM, PathConfig(kind="rings", frames=views, radius_m=RADIUS_M, elevations_deg=RINGS)
    else:
        room = RoomConfig(kind="bare")
        path = PathConfig(
            frames=views,
            degrees_per_frame=360 / views,
            radius_m=RADIUS_M,
            elevations_deg=(PAPER_ELEVATION_DEG,),
        )
    sensor = DepthSensor(noise_free=noise_free)
    scene = ObjectScene(camera=CAMERA, room=room, path=path, sensor=sensor)
    recording = film_object("object", mesh, scene, seed)
    poses = recording.trajectory.reference_from_camera
    reference_from_world = np.linalg.inv(poses[0])
    return ObjectFilm(
        mesh=mesh,
        recording=recording,
        frames=list(recording),
        trajectory=reference_from_world @ poses,
        reference_from_mesh=reference_from_world @ recording.truth.objects[0].world_from_object,
    )


def with_true_poses(film: ObjectFilm) -> PosedFilm:
    """All frames where they really were."""
    return PosedFilm(
        frames=film.frames,
        trajectories=film.trajectory[None],
        log_weights=np.zeros(1),
        reference_from_mesh=film.reference_from_mesh,
    )


def with_slam(film: ObjectFilm, seed: int, *, orbit: bool = False) -> PosedFilm:
    """The frames that slam did not lose, where it says they were.

    Args:
        film: what is tracked.
        seed: of the filter.
        orbit: as the supplement has it: the camera is known to keep its distance, and the object's pose in
            the first frame is given.

    Raises:
        PipelineError: slam lost every frame.
    """
    key = jax.random.key(seed)
    config = SlamConfig(motion="orbit", orbit_radius_m=RADIUS_M) if orbit else SlamConfig()
    result = track(key, film.frames, film.recording.intrinsics, config, lambda _: None)
    posed = tracked_frames(result)
    camera_from_mesh = np.linalg.inv(film.trajectory) @ film.reference_from_mesh
    return PosedFilm(
        frames=[frame for frame, lost in zip(film.frames, result.lost, strict=True) if not lost],
        trajectories=posed.trajectories,
        log_weights=posed.log_weights,
        reference_from_mesh=film.reference_from_mesh
        if orbit
        else pose_in_reference((result.mean @ camera_from_mesh)[~result.lost]),
    )
