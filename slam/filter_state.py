"""What the camera filter carries from frame to frame, and what it tells of each."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray

from slam import smc
from slam.calibration import Calibration
from slam.keyframe_map import KeyframeMap
from slam.motion import MotionPrior


@dataclass(frozen=True)
class FilterState:
    """What is carried from frame to frame.

    Attributes:
        population: weighted `CameraParticles`.
        keyframe_map: shared surfaces.
        keyframe_times_ns: (N,) their stamps.
        calibration: of the sensor.
        motion: prior over motion.
        times_ns: stamps of the last two frames.
        last_found: (7,) mean pose of the last frame that was found.
        was_lost: whether the last frame was not.
        steps_were_wide: whether the camera ever turned far from one frame to the next.
    """

    population: smc.Population
    keyframe_map: KeyframeMap
    keyframe_times_ns: tuple[int, ...]
    calibration: Calibration
    motion: MotionPrior
    times_ns: tuple[int, int]
    last_found: jax.Array
    was_lost: bool
    steps_were_wide: bool


@dataclass(frozen=True)
class FrameInfo:
    """What one frame gave. Poses are relative to the particle's keyframe `anchor`.

    Attributes:
        anchor: index of a keyframe.
        relative_poses: (K, 7) anchor_from_camera, each particle's draw.
        relative_means: (K, 7) the same, centres of the components that the draws came from; the pose last
            found where the frame is lost, so that its spread outlives the particles.
        component: (K,) which component that was.
        component_covariances: (J, 6, 6) of the draws around their centres, camera chart.
        log_weights: (K,) normalised, after this frame.
        ancestors: (K,) particle before this frame that each one continues.
        log_evidence: increment.
        ess: after weighting.
        resampled: whether particles were drawn anew.
        lost: whether no pose agreed with the map.
        explained: share of returns on the map's surface.
        covered: share of returns that meet the map.
        keyframes: number of keyframes after this frame.
        keyframe: index of the one that this frame became, if it did.
        components: number of components of the proposal.
    """

    anchor: int
    relative_poses: NDArray[np.float32]
    relative_means: NDArray[np.float32]
    component: NDArray[np.int32]
    component_covariances: NDArray[np.float32]
    log_weights: NDArray[np.float32]
    ancestors: NDArray[np.int32]
    log_evidence: float
    ess: float
    resampled: bool
    lost: bool
    explained: float
    covered: float
    keyframes: int
    keyframe: int | None
    components: int
