"""The filter's `init`: the first frame with enough returns is the reference and the first keyframe."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from shapes.geometry.pose_sets import IDENTITY, spread_around
from slam.config import SlamConfig
from slam.filter import smc
from slam.filter.motion import FreeMotion, MotionHistory, MotionPrior, OrbitMotion
from slam.filter.rival_motion import CERTAIN, RivalMotion
from slam.filter.state import CameraParticles, FilterState, FrameInfo, Ties, initial_particles
from slam.keyframes.depth_view import CanvasView, central_depth
from slam.keyframes.keyframe_map import KeyframeMap
from slam.keyframes.pages import PageFile
from slam.keyframes.surfels import surfel_image
from slam.likelihood.distortion import NODES
from slam.likelihood.noise_calibration import NoiseCalibration

LOOSE_RADIUS = 0.15
"""Relative standard deviation of an orbit's radius that nobody gave."""


def init(
    view: CanvasView, time_ns: int, config: SlamConfig, pages: PageFile | None = None
) -> tuple[FilterState, FrameInfo]:
    """The state after the first frame, which is the reference and the first keyframe.

    Args:
        view: of the frame.
        time_ns: its stamp.
        config: settings.
        pages: where keyframes go that are not asked for; None keeps them in memory.
    """
    radius = config.orbit_radius_m or central_depth(view)
    motion: MotionPrior = FreeMotion.default()
    if config.motion == "orbit":
        known = config.orbit_radius_m is not None
        motion = OrbitMotion.default() if known else OrbitMotion.of_unknown_radius(LOOSE_RADIUS * radius)
    calibration = NoiseCalibration.initial(config.noise, config.effective_pixel_share)
    pivot = np.asarray([0.0, 0.0, radius], np.float32)
    particles = initial_particles(config.particles, pivot)
    surface = surfel_image(view, calibration.noise)
    state = FilterState(
        population=smc.uniform_population(particles),
        keyframe_poses=np.tile(np.asarray(IDENTITY, np.float32), (config.particles, 1, 1)),
        keyframe_map=KeyframeMap(pages=pages or PageFile()).with_keyframe(surface),
        keyframe_times_ns=(time_ns,),
        calibration=calibration,
        motion=motion,
        times_ns=(time_ns, time_ns),
        last_found=jnp.asarray(IDENTITY, jnp.float32),
        was_lost=False,
        steps_were_wide=False,
        rival=RivalMotion.since(surface),
    )
    return state, _first_frame_info(config.particles, config.keyframes_compared)


def info_before_map(key: jax.Array, state: FilterState, config: SlamConfig) -> FrameInfo:
    """A frame before the first that shows anything: lost, anywhere that the motion prior leads from there.

    Args:
        key: consumed.
        state: after the first frame that does, by `init`.
        config: settings.
    """
    count = len(state.population.log_weights)
    poses = _moved_unseen(jax.random.split(key, count), state)
    spread = spread_around(jnp.asarray(IDENTITY, jnp.float32), poses, state.population.log_weights)
    return replace(
        _first_frame_info(count, config.keyframes_compared),
        relative_poses=np.asarray(poses),
        component_covariances=np.asarray(spread)[None],
        lost=True,
        explained=0.0,
        covered=0.0,
        is_keyframe=False,
    )


def _moved_unseen(keys: jax.Array, state: FilterState) -> jax.Array:
    """Poses (K, 7), each a step of the motion prior from that of the particle."""
    particles: CameraParticles = state.population.particles

    def one(key: jax.Array, pose: jax.Array, pivot: jax.Array) -> jax.Array:
        return state.motion.sample(key, MotionHistory(pose, pose, pivot))

    return jax.vmap(one)(keys, particles.pose, particles.pivot)


def _first_frame_info(count: int, compared: int) -> FrameInfo:
    """The reference itself: certain, and no evidence for or against anything."""
    at_anchor = np.tile(np.asarray(IDENTITY, np.float32), (count, 1))
    return FrameInfo(
        anchor=0,
        relative_poses=at_anchor,
        relative_means=at_anchor,
        component=np.zeros(count, np.int32),
        component_covariances=np.zeros((1, 6, 6), np.float32),
        field_sensitivity=np.zeros((6, NODES), np.float32),
        ties=Ties.none(compared),
        log_weights=np.full(count, -np.log(count), np.float32),
        ancestors=np.arange(count, dtype=np.int32),
        log_evidence=0.0,
        ess=float(count),
        resampled=False,
        lost=False,
        unexpected=False,
        explained=1.0,
        covered=1.0,
        keyframes=1,
        is_keyframe=True,
        components=0,
        doubt=CERTAIN,
    )
