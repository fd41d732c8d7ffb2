"""The value that SLAM gives: weighted trajectories, and what is known of every frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from recordings.distortion_field import NODE_COLUMNS, NODE_ROWS, DistortionField
from recordings.sensor_profile import SensorProfile
from recordings.types import CameraIntrinsics, Trajectory
from shapes.archive import Archived
from shapes.geometry.pose_sets import cluster
from shapes.geometry.poses import matrices_of

COMPARED_FRAMES = 2000
"""50 MB while paths are told apart."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SlamResult(Archived):
    """Posterior over the camera's trajectory. The reference is the camera of the first frame found.

    Attributes:
        times_ns: (T,) int64 stamps.
        draws: (K, T, 7) float32 trajectories, equally likely draws, reference_from_camera, wxyz_xyz.
        log_weights: (K,) normalised, equal.
        mean: (T, 4, 4) float64 marginal posterior mean of every frame, given all frames; where several maps
            are left, that of the likeliest.
        covariance: (T, 6, 6) second moment around the mean, all maps that are left included, in the right
            tangent there: translation in metres, then rotation in radians, both in the camera's own axes.
        degrees_of_freedom: () of the marginals, which are Student-t: heavier tails than a Gaussian's.
        hypotheses: (T,) effective number of them after each frame, 1 / sum of squared weights.
        log_evidence: (T,) increments; their sum estimates log p(I_1..T) with the image density tempered.
        resampled: (T,) bool, hypotheses were given up, by their weights.
        lost: (T,) bool, no pose agreed with the map, or nothing ties the keyframe that it agreed with to the
            first.
        explained: (T,) share of the returns that lay on the map's surface.
        undiscovered: () probability that the true map was not found, where a search for it was made; else 0.
        disparity_per_m: (rows, columns) the sensor's distortion field at the nodes of
            `recordings.distortion_field`, 1/m: mean, where several maps are left in the likeliest.
        disparity_sd_per_m: alike, standard deviations.
        camera: (6,) width, height, fx, fy, cx, cy of the images that the field is of, pixels.
    """

    FORMAT_VERSION: ClassVar[int] = 6
    TITLE: ClassVar[str] = "SLAM result"
    OLDER_FORMATS: ClassVar[Mapping[int, Mapping[str, str]]] = {4: {"ess": "hypotheses"}, 5: {}}
    ADDED: ClassVar[Mapping[str, float]] = {"undiscovered": 0.0}
    times_ns: NDArray[np.int64]
    draws: NDArray[np.float32]
    log_weights: NDArray[np.float64]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    degrees_of_freedom: NDArray[np.float64]
    hypotheses: NDArray[np.float64]
    log_evidence: NDArray[np.float64]
    resampled: NDArray[np.bool_]
    lost: NDArray[np.bool_]
    explained: NDArray[np.float64]
    undiscovered: NDArray[np.float64]
    disparity_per_m: NDArray[np.float64]
    disparity_sd_per_m: NDArray[np.float64]
    camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        particles, frames = self.draws.shape[:2]
        expected = {
            "times_ns": (frames,),
            "draws": (particles, frames, 7),
            "log_weights": (particles,),
            "mean": (frames, 4, 4),
            "covariance": (frames, 6, 6),
            "degrees_of_freedom": (),
            "undiscovered": (),
            "camera": (6,),
            **dict.fromkeys(("disparity_per_m", "disparity_sd_per_m"), (NODE_ROWS, NODE_COLUMNS)),
            **dict.fromkeys(("hypotheses", "log_evidence", "resampled", "lost", "explained"), (frames,)),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, expected {shape}")

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.times_ns)

    @property
    def tracked_path(self) -> Trajectory:
        """Mean poses of the frames that were not lost."""
        found = ~self.lost
        return Trajectory(times_ns=self.times_ns[found], reference_from_camera=self.mean[found])

    @property
    def sensor(self) -> SensorProfile:
        """What was learnt of the sensor.

        Raises:
            ValueError: the numbers are those of no sensor.
        """
        width, height, fx, fy, cx, cy = self.camera.tolist()
        camera = CameraIntrinsics(width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy)
        distortion = DistortionField(disparity_per_m=self.disparity_per_m, sd_per_m=self.disparity_sd_per_m)
        return SensorProfile(intrinsics=camera, distortion=distortion)

    @property
    def trajectories(self) -> NDArray[np.float64]:
        """(K, T, 4, 4) the draws as matrices: 8 kB a frame of 64."""
        return matrices_of(self.draws)

    @property
    def path_probabilities(self) -> NDArray[np.float64]:
        """Of the paths (G,) that are told apart, the likeliest first: one where all draws agree.

        Frames that were found decide, of a long recording every so many.
        """
        weights, found = np.exp(self.log_weights), np.flatnonzero(~self.lost)
        if not len(found):
            return np.ones(1)
        compared = matrices_of(self.draws[:, found[:: -(-len(found) // COMPARED_FRAMES)]])
        shares = np.bincount(cluster(compared, weights), weights).astype(np.float64)
        return np.sort(shares)[::-1]
