"""A recording that is rendered while it is read, with the truth beside it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import jax
import numpy as np
from numpy.typing import NDArray

from pipeline.colours import AMBIENT
from pipeline.synthesis.sensor import DepthSensor
from pipeline.synthesis.world import NOTHING, Part, RayCaster, View
from recordings.truth import SceneTruth
from recordings.types import CameraIntrinsics, Frame, Trajectory

CAMERA = (1 << 32) - 1
"""In place of a frame's number where what all frames share is drawn."""

FRAME_NS = 33_333_333
"""From frame to frame, at 30 a second."""


class SyntheticRecording:
    """Frames of a synthetic world (the `Recording` protocol), drawn anew and alike at each iteration.

    Attributes:
        intrinsics: the camera.
        trajectory: true poses; the reference is the world frame of `truth`, z up.
        truth: the objects of interest.
        sensor: how depth is measured.
        disparity_per_m: the drawn camera's distortion field at its nodes, None without one.
    """

    def __init__(
        self,
        parts: Sequence[Part],
        truth: SceneTruth,
        trajectory: Trajectory,
        intrinsics: CameraIntrinsics,
        sensor: DepthSensor,
        seed: int,
    ) -> None:
        """A camera filming `parts` along `trajectory`; `seed` draws the sensor's noise."""
        self.intrinsics = intrinsics
        self.trajectory = trajectory
        self.truth = truth
        self._caster = RayCaster(parts)
        self.sensor = sensor
        self._key = jax.random.key(seed)
        camera_key = jax.random.fold_in(self._key, CAMERA)
        self._depth_scale = sensor.drawn_scale(camera_key)
        self.disparity_per_m = sensor.drawn_distortion(jax.random.fold_in(camera_key, 1))

    @classmethod
    def of_surroundings(
        cls,
        parts: Sequence[Part],
        poses: NDArray[np.float64],
        intrinsics: CameraIntrinsics,
        sensor: DepthSensor,
        seed: int,
        frame_ns: int = FRAME_NS,
    ) -> SyntheticRecording:
        """Seen from world_from_camera (T, 4, 4), none of the parts being an object of interest."""
        trajectory = Trajectory(times_ns=frame_ns * np.arange(len(poses)), reference_from_camera=poses)
        return cls(parts, SceneTruth(objects=(), support_plane=None), trajectory, intrinsics, sensor, seed)

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.trajectory)

    def __iter__(self) -> Iterator[Frame]:
        """Every frame once."""
        return map(self.frame, range(len(self)))

    def frame(self, index: int) -> Frame:
        """The measured frame of that index."""
        view = self.ideal_view(index)
        return Frame(
            time_ns=int(self.trajectory.times_ns[index]),
            depth_m=self.sensor.measure(
                jax.random.fold_in(self._key, index),
                view,
                view.rgb.mean(axis=-1) / 255,
                self._depth_scale,
                self.disparity_per_m,
            ),
            rgb=self._shaded(view),
        )

    def ideal_view(self, index: int) -> View:
        """What a camera without noise sees at that frame."""
        return self._caster.view(self.intrinsics, self.trajectory.reference_from_camera[index])

    def clearance_m(self, points_m: NDArray[np.floating]) -> NDArray[np.float32]:
        """Distance of world points (N, 3) from the nearest true surface."""
        return self._caster.clearance_m(points_m)

    def _shaded(self, view: View) -> NDArray[np.uint8]:
        """Colours (H, W, 3) under a lamp at the camera."""
        light = np.where(view.part == NOTHING, 0.0, AMBIENT + (1 - AMBIENT) * view.cos_incidence)
        return (view.rgb * light[..., None]).astype(np.uint8)
