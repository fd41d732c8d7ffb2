"""The value that parsing a scene gives: which objects stand where, on what, and how sure that is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from shapes.archive import Archived
from shapes.geometry.poses import matrices_of, poses_of

TABLE = "table"

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneResult(Archived):
    """Posterior over the scene of one recording, in the camera of the first depth frame used.

    N objects were looked for; those that were not found stay in the arrays, without a visible fraction. What
    can stand unseen may be there all the same, with a `presence` up to its prior.

    Attributes:
        names: (N,) str.
        frames: (F,) int64 indices of the depth frames used.
        camera_from_object: (N, 4, 4) float64, posterior mean at the densest place of the heaviest mode.
        covariance: (N, 6, 6) second moment of all samples round it, in the right tangent there, translation
            first; other modes are part of it, and errors that all pixels share (`scene.common_errors`).
        most_probable: (N, 4, 4) where the sample of the greatest posterior density appears.
        presence: (N,) probability that the object is there.
        presence_std: (N,) its standard error: of how chains of presence differ, and of the number of poses at
            which hidden objects were tried.
        hidden_presence: (N,) probability that it is there and not in sight; NaN in files of format 7.
        number_probabilities: (N, N + 1) that so many are there of the shape of each object.
        hidden_share: (N,) of an object not found the mean likelihood ratio over prior poses, about the share
            of them that no image shows; 0 of those found.
        hidden_poses: (N, K, 7) float64 camera_from_object in draws of the posterior of an object not found,
            given that it is there.
        visible_fraction: (N,) share of its pixels that nothing hides, in the frame of its search, or in the
            first that shows it.
        colour_nats: (N,) log factor of the best scene's density that its colours bring, depth apart; 0 where
            none were looked at.
        mode_poses: (N, M, 4, 4) the modes that the samples visit, the heaviest first.
        mode_probabilities: (N, M), 0 where there are fewer.
        sample_modes: (S, N) int32 the mode of each sample, -1 in none of those.
        edge_probabilities: (N, N + S) of resting on each object, and on the supports, the table first.
        edge_faces: (N, N + S, 2) int32 own and parent's face most often seen on that edge; -1 without.
        sample_poses: (S, N, 7) float64 camera_from_object, wxyz_xyz, with draws of these errors.
        sample_parents: (S, N) int32, -1 floating, N the table, N + 1 the next support.
        sample_log_posteriors: (S,) not normalised.
        chain: (S,) int32 the chain of each sample.
        acceptance: () share of the chains' moves of poses that were accepted.
        log_estimate_variance: () of the log likelihood's estimate when all shapes are drawn anew, 0 where
            they are certain.
    """

    FORMAT_VERSION: ClassVar[int] = 8
    TITLE: ClassVar[str] = "scene result"
    OLDER_FORMATS: ClassVar[Mapping[int, Mapping[str, str]]] = {7: {}}
    ADDED: ClassVar[Mapping[str, float]] = {"hidden_presence": np.nan}
    names: NDArray[np.str_]
    frames: NDArray[np.int64]
    camera_from_object: NDArray[np.float64]
    covariance: NDArray[np.float64]
    most_probable: NDArray[np.float64]
    presence: NDArray[np.float64]
    presence_std: NDArray[np.float64]
    hidden_presence: NDArray[np.float64]
    number_probabilities: NDArray[np.float64]
    hidden_share: NDArray[np.float64]
    hidden_poses: NDArray[np.float64]
    visible_fraction: NDArray[np.float64]
    colour_nats: NDArray[np.float64]
    mode_poses: NDArray[np.float64]
    mode_probabilities: NDArray[np.float64]
    sample_modes: NDArray[np.int32]
    edge_probabilities: NDArray[np.float64]
    edge_faces: NDArray[np.int32]
    sample_poses: NDArray[np.float64]
    sample_parents: NDArray[np.int32]
    sample_log_posteriors: NDArray[np.float64]
    chain: NDArray[np.int32]
    acceptance: NDArray[np.float64]
    log_estimate_variance: NDArray[np.float64]

    def __len__(self) -> int:
        """Number of objects looked for."""
        return len(self.names)

    @property
    def found(self) -> NDArray[np.bool_]:
        """(N,) objects more probably there than not, and seen."""
        return (self.presence >= 0.5) & (self.visible_fraction > 0)

    @property
    def presence_out_of_sight(self) -> NDArray[np.float64]:
        """(N,) `hidden_presence`, of files that do not tell it all of the presence."""
        told = np.nan_to_num(self.hidden_presence, nan=np.inf)
        return np.minimum(told, self.presence)

    @property
    def supports(self) -> list[str]:
        """Names of what objects stand on that is none itself, that which carries most first."""
        count = self.edge_probabilities.shape[1] - len(self)
        return [TABLE, *(f"plane_{number + 2}" for number in range(count - 1))]

    @property
    def found_poses(self) -> list[tuple[str, NDArray[np.float64]]]:
        """Name and camera_from_object (4, 4) of each of them."""
        return [(str(self.names[one]), self.camera_from_object[one]) for one in np.flatnonzero(self.found)]

    @property
    def position_std_m(self) -> NDArray[np.float64]:
        """(N,) root mean square distance of the origin from where it is in the mean pose."""
        offsets_m = self.sample_poses[..., 4:] - self.camera_from_object[:, :3, 3]
        return np.sqrt((offsets_m**2).sum(axis=-1).mean(axis=0))

    @property
    def rotation_std_rad(self) -> NDArray[np.float64]:
        """(N,) root mean square angle from the mean orientation."""
        return np.sqrt(np.trace(self.covariance[:, 3:, 3:], axis1=1, axis2=2))

    def sampled_points(self, one: int, point_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where a point (3,) of an object is in each sample (S, 3), in the camera."""
        poses = matrices_of(self.sample_poses[:, one])
        return poses[:, :3, :3] @ point_m + poses[:, :3, 3]

    def covariance_of_point(
        self, one: int, point_m: NDArray[np.float64], mode: int | None = None
    ) -> NDArray[np.float64]:
        """Second moment (3, 3) of a point (3,) of an object round its place at the mean pose, in the camera.

        Args:
            one: the object.
            point_m: in the object's own frame; the middle says most, for the origin may lie at an edge.
            mode: of its samples in this mode alone, round their own mean; None takes all samples.
        """
        points = self.sampled_points(one, point_m)
        centre = self.camera_from_object[one, :3, :3] @ point_m + self.camera_from_object[one, :3, 3]
        if mode is not None:
            points = points[self.sample_modes[:, one] == mode]
            centre = points.mean(axis=0)
        return (points - centre).T @ (points - centre) / len(points)

    def in_camera(self, camera_from_this: NDArray[np.float64]) -> SceneResult:
        """The same in another camera, (4, 4) from this one's."""
        return replace(
            self,
            camera_from_object=camera_from_this @ self.camera_from_object,
            most_probable=camera_from_this @ self.most_probable,
            mode_poses=camera_from_this @ self.mode_poses,
            sample_poses=poses_of(camera_from_this @ matrices_of(self.sample_poses)),
            hidden_poses=poses_of(camera_from_this @ matrices_of(self.hidden_poses)),
        )
