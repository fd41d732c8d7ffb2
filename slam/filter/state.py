"""State of the camera filter: hypotheses, map, calibration; and what it reports of each frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from slam.filter import smc
from slam.filter.motion import MotionHistory, MotionPrior
from slam.filter.rival_motion import Doubt, RivalMotion
from slam.keyframes.covisibility import together_with
from slam.keyframes.keyframe_map import KeyframeMap
from slam.likelihood.noise_calibration import NoiseCalibration


@dataclass(frozen=True)
class Hypothesis:
    """One discrete history, the place that every frame was put at, as far as the future depends on it.

    Poses are those that are likeliest given these places, wxyz_xyz, reference_from_*; on the host, for a
    kernel would be compiled for every number of keyframes.

    Attributes:
        keyframe_poses: (N, 7).
        pose: (7,) of the last frame that was found.
        previous_pose: (7,) of the one before; the same where the last one was lost.
        overlaps: (E, 2) pairs of keyframes that were found to see the same.
        anchor: keyframe next to which the last frame was found.
    """

    keyframe_poses: NDArray[np.float32]
    pose: NDArray[np.float32]
    previous_pose: NDArray[np.float32]
    overlaps: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 2), np.int32))
    anchor: int = 0

    @property
    def at_hand(self) -> NDArray[np.bool_]:
        """Keyframes (N,) that are held together with the anchor; others may be where they are by drift."""
        return together_with(self.anchor, len(self.keyframe_poses), self.overlaps)


@dataclass(frozen=True)
class FilterState:
    """What is carried from frame to frame.

    Attributes:
        population: weighted hypotheses.
        keyframe_map: shared surfaces.
        keyframe_times_ns: (N,) their stamps.
        calibration: of the sensor.
        motion: prior over motion.
        pivot: (3,) what an orbit looks at, in the reference frame, metres.
        unseen_step: (6, 6) second moment of a step that only the prior tells of.
        times_ns: stamps of the previous pose and the last one; the same where the last frame was lost.
        lost_frames: how many in a row were not found.
        steps_were_wide: whether the camera ever moved far from one frame to the next.
        rival: what moves against the camera's motion.
        refined_keyframes: how many there were when the map was last refined.
        contradicted: whether a frame has contradicted keyframes in sight since, which drift may have brought
            there.
    """

    population: smc.Population[Hypothesis]
    keyframe_map: KeyframeMap
    keyframe_times_ns: tuple[int, ...]
    calibration: NoiseCalibration
    motion: MotionPrior
    pivot: NDArray[np.float32]
    unseen_step: NDArray[np.float32]
    times_ns: tuple[int, int]
    lost_frames: int
    steps_were_wide: bool
    rival: RivalMotion
    refined_keyframes: int = 1
    contradicted: bool = False

    def past_of(self, hypothesis: Hypothesis, predicted: NDArray[np.float32]) -> MotionHistory:
        """What the motion prior looks at, constant velocity leading to `predicted` (7,)."""
        return MotionHistory(jnp.asarray(hypothesis.pose), jnp.asarray(predicted), jnp.asarray(self.pivot))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ties:
    """How frames follow the keyframes that they were compared with, to first order (`slam.filter.places`).

    Keyframes that disagree with each other, as where a camera comes back with a drift, pull it between them:
    once they have been refined it follows each of them in what that one told of it.

    Attributes:
        keyframes: (..., M) indices, the frame's anchor first.
        keyframes_from_camera: (..., M, 7) where it was found.
        shares: (..., M, 6, 6) of their displacements, camera chart; zero where the frame is lost or a
            keyframe.
    """

    keyframes: NDArray[np.int32]
    keyframes_from_camera: NDArray[np.float32]
    shares: NDArray[np.float32]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FoundPlaces:
    """Where each of H hypotheses has a frame, beside a keyframe: its anchor.

    Attributes:
        anchors: (H,) indices of keyframes.
        relative_poses: (H, 7) anchor_from_camera; the pose last found where the frame is lost.
        covariances: (H, 6, 6) camera chart.
        field_sensitivity: (H, 6, NODES) how the pose follows the sensor's distortion field, camera chart
            (`slam.registration.field_sensitivity`); zero where the frame is lost or became a keyframe.
        ties: leaves (H, ...), to the keyframes that it was compared with.
        ancestors: (H,) hypothesis before this frame that each one goes on.
    """

    anchors: NDArray[np.int32]
    relative_poses: NDArray[np.float32]
    covariances: NDArray[np.float32]
    field_sensitivity: NDArray[np.float32]
    ties: Ties
    ancestors: NDArray[np.int32]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FrameInfo:
    """What one frame gave.

    Attributes:
        places: of the hypotheses that are left.
        log_evidence: increment.
        hypotheses: effective number of them, 1 / sum w^2.
        resampled: whether some of those that might be were drawn.
        lost: whether no pose agreed with the map.
        unexpected: whether no pose agreed where the camera was expected, and the map was searched.
        explained: share of returns on the map's surface.
        keyframes: number of keyframes after this frame.
        is_keyframe: whether it became the last of them.
        doubt: what a second motion leaves open about it.
    """

    places: FoundPlaces
    log_evidence: float
    hypotheses: float
    resampled: bool
    lost: bool
    unexpected: bool
    explained: float
    keyframes: int
    is_keyframe: bool
    doubt: Doubt
