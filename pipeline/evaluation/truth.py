"""The truth of a recording, brought into a run's reference frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.errors import PipelineError
from pipeline.evaluation.trajectories import compared
from pipeline.publishing.trajectory_files import seconds_text
from recordings.options import ReadOptions
from recordings.poses.recorded import recorded_trajectory
from recordings.truth import SceneTruth, TrueObject, recorded_scene_truth
from recordings.types import Trajectory

_DEFAULT_OPTIONS = ReadOptions()
MEDIAN_ROUNDS = 30
SAME_ROTATION_RAD = 1e-4


class RecordedTruth:
    """What really stood in front of a recording's camera, and where the camera was.

    Attributes:
        scene: the objects, in the world of `trajectory`.
        trajectory: the camera at the stamps of its frames.
    """

    def __init__(self, path: Path, options: ReadOptions = _DEFAULT_OPTIONS) -> None:
        """Read the truth of a recording.

        Args:
            path: of the recording.
            options: how it is read.

        Raises:
            RecordingError: the recording cannot be read.
            PipelineError: it holds no truth.
        """
        scene, trajectory = recorded_scene_truth(path), recorded_trajectory(path, options)
        if scene is None or trajectory is None:
            what = "objects" if scene is None else "camera poses"
            raise PipelineError(f"{path} holds no true {what}; voxscene synth and import write them")
        self._path = path
        self.scene: SceneTruth = scene
        self.trajectory: Trajectory = trajectory

    def camera_from_world(self, time_ns: int | None) -> NDArray[np.float64]:
        """Inverse pose (4, 4) of the camera at the stamp of a frame, as far as that is known.

        Raises:
            PipelineError: the stamp is not known, or the recording has no true pose at that time.
        """
        if time_ns is None:
            raise PipelineError("the run does not say when what was parsed was seen; parse it again")
        found = np.flatnonzero(self.trajectory.times_ns == time_ns)
        if not len(found):
            raise PipelineError(
                f"{self._path} has no true camera pose at {seconds_text(time_ns)} s; is it the right one?"
            )
        return np.asarray(np.linalg.inv(self.trajectory.reference_from_camera[found[0]]), np.float64)

    def object_of_shape(self, shape: str) -> TrueObject:
        """The object that a learned shape stands for: of its name, or the only one.

        Raises:
            PipelineError: several objects could be meant, or none.
        """
        objects = self.scene.objects
        named = [one for one in objects if shape in (one.name, one.shape)] or list(objects)
        if len(named) != 1:
            raise PipelineError(
                f"{self._path} holds {', '.join(one.name for one in objects) or 'no object'}: "
                f"which of them is the shape {shape}?"
            )
        return named[0]

    def reference_from_object(self, one: TrueObject, path: Trajectory) -> NDArray[np.float64]:
        """Pose (4, 4) of a true object in a run's reference frame, as all its frames together have it.

        See `pose_in_reference`.

        Raises:
            PipelineError: fewer than two frames have a true pose.
        """
        frames, world_from_camera = compared(path.times_ns, self.trajectory)
        camera_from_object = np.linalg.inv(world_from_camera) @ one.world_from_object
        return pose_in_reference(path.reference_from_camera[frames] @ camera_from_object)


def pose_in_reference(reference_from_object: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where an object is (4, 4), from what every tracked frame says of it (T, 4, 4) by its true pose.

    The medians of their rotations (geodesic L1, Hartley et al. 2013) and places, so that a single frame's
    error, the first one's included, is not taken for one of a shape that was learned from all of them.
    """
    rotations = Rotation.from_matrix(reference_from_object[:, :3, :3])
    middle = rotations.mean()
    for _ in range(MEDIAN_ROUNDS):
        apart = (rotations * middle.inv()).magnitude()
        middle = rotations.mean(weights=1.0 / np.maximum(apart, SAME_ROTATION_RAD))
    pose = np.eye(4)
    pose[:3, :3] = middle.as_matrix()
    pose[:3, 3] = np.median(reference_from_object[:, :3, 3], axis=0)
    return pose


def true_mesh(one: TrueObject) -> trimesh.Trimesh:
    """The surface of a true object.

    Raises:
        PipelineError: the recording does not bring it.
    """
    if one.vertices_m is None or one.faces is None:
        raise PipelineError(f"the recording's truth names {one.shape} but does not bring its surface")
    return trimesh.Trimesh(one.vertices_m, one.faces, process=False)
