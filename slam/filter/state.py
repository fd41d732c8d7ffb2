"""State of the camera filter: particles, map, calibration; and what it reports of each frame."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from shapes.geometry.pose_sets import IDENTITY
from slam.filter import smc
from slam.filter.motion import MotionPrior
from slam.filter.rival_motion import Doubt, RivalMotion
from slam.keyframes.keyframe_map import KeyframeMap
from slam.likelihood.noise_calibration import NoiseCalibration


@dataclass(frozen=True)
class FilterState:
    """What is carried from frame to frame.

    Attributes:
        population: K weighted `CameraParticles`.
        keyframe_poses: (K, N, 7) where each has the keyframes, reference_from_keyframe. On the host, for a
            kernel would be compiled for every number of them.
        keyframe_map: shared surfaces.
        keyframe_times_ns: (N,) their stamps.
        calibration: of the sensor.
        motion: prior over motion.
        times_ns: stamps of the last two frames.
        last_found: (7,) mean pose of the last frame that was found.
        was_lost: whether the last frame was not.
        steps_were_wide: whether the camera ever turned far from one frame to the next.
        rival: what moves against the camera's motion.
    """

    population: smc.Population
    keyframe_poses: NDArray[np.float32]
    keyframe_map: KeyframeMap
    keyframe_times_ns: tuple[int, ...]
    calibration: NoiseCalibration
    motion: MotionPrior
    times_ns: tuple[int, int]
    last_found: jax.Array
    was_lost: bool
    steps_were_wide: bool
    rival: RivalMotion


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Ties:
    """How a frame follows the keyframes that it was compared with, to first order (`slam.filter.proposal`).

    Keyframes that disagree with each other, as where a camera comes back with a drift, pull it between them:
    once they have been refined it follows each of them in what that one told of it.

    Attributes:
        keyframes: (M,) indices, the frame's anchor first.
        keyframes_from_camera: (M, 7) where it was found.
        shares: (M, 6, 6) of their displacements, camera chart; zero where the frame is lost or a keyframe.
    """

    keyframes: NDArray[np.int32]
    keyframes_from_camera: NDArray[np.float32]
    shares: NDArray[np.float32]

    @classmethod
    def none(cls, count: int) -> Ties:
        """Of a frame that was compared with nothing; M is `count`."""
        at_keyframes = np.tile(np.asarray(IDENTITY, np.float32), (count, 1))
        return cls(np.zeros(count, np.int32), at_keyframes, np.zeros((count, 6, 6), np.float32))


@jax.tree_util.register_dataclass
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
        field_sensitivity: (6, NODES) how the pose follows the sensor's distortion field, camera chart
            (`slam.registration.field_sensitivity`); zero where the frame is lost or became a keyframe.
        ties: of the best component to the keyframes that it was compared with.
        log_weights: (K,) normalised, after this frame.
        ancestors: (K,) particle before this frame that each one continues.
        log_evidence: increment.
        ess: after weighting.
        resampled: whether particles were drawn anew.
        lost: whether no pose agreed with the map.
        unexpected: whether no pose agreed where the camera was expected, and the map was searched.
        explained: share of returns on the map's surface.
        covered: share of returns that meet the map.
        keyframes: number of keyframes after this frame.
        is_keyframe: whether it became the last of them.
        components: number of components of the proposal.
        doubt: what a second motion leaves open about it.
    """

    anchor: int
    relative_poses: NDArray[np.float32]
    relative_means: NDArray[np.float32]
    component: NDArray[np.int32]
    component_covariances: NDArray[np.float32]
    field_sensitivity: NDArray[np.float32]
    ties: Ties
    log_weights: NDArray[np.float32]
    ancestors: NDArray[np.int32]
    log_evidence: float
    ess: float
    resampled: bool
    lost: bool
    unexpected: bool
    explained: float
    covered: float
    keyframes: int
    is_keyframe: bool
    components: int
    doubt: Doubt


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CameraParticles:
    """K trajectories, as far as the future depends on them. Poses are wxyz_xyz, reference_from_*.

    Attributes:
        pose: (K, 7) of the last frame.
        previous_pose: (K, 7) of the frame before.
        pivot: (K, 3) what an orbit looks at, in the reference frame, metres.
    """

    pose: jax.Array
    previous_pose: jax.Array
    pivot: jax.Array


def initial_particles(count: int, pivot: NDArray[np.float32]) -> CameraParticles:
    """Every camera at the reference, which is the first keyframe."""
    poses = jnp.tile(jnp.asarray(IDENTITY, jnp.float32), (count, 1))
    pivots = jnp.tile(jnp.asarray(pivot, jnp.float32), (count, 1))
    return CameraParticles(pose=poses, previous_pose=poses, pivot=pivots)
