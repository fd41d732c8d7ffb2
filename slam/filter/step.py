"""The filter's `step`, one frame further (`slam.filter.init` begins it), and its report of the frame.

A step finds local optima of the frame's density (`slam.filter.pose_hypotheses`), makes them a mixture
proposal (`slam.filter.proposal`), runs the generic sequential Monte Carlo step (`slam.filter.smc`), and fuses
the frame into the map or adds it as a keyframe (`slam.filter.map_update`). Reported poses are relative to a
keyframe, so that later refinement of the keyframe carries them along.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from shapes.geometry.pose_sets import spread_around, turns_wide
from slam.config import SlamConfig
from slam.filter import smc
from slam.filter.map_update import with_calibration, with_frame
from slam.filter.motion import MotionHistory, MotionPrior
from slam.filter.pose_hypotheses import MAX_HYPOTHESES, find_pose_hypotheses, last_motion, predict
from slam.filter.proposal import Component, Proposed, component_at, propose_all
from slam.filter.rival_motion import CERTAIN, Doubt, doubt_of_frame
from slam.filter.state import CameraParticles, FilterState, FrameInfo, Ties
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.keyframe_map import stacked
from slam.likelihood.distortion import NODES, NodeWeights
from slam.registration.field_sensitivity import field_sensitivity
from slam.registration.registered import Registration

COMPONENT_BUCKETS = (1, 2, 4, MAX_HYPOTHESES)
"""Numbers of mixture components for which kernels are compiled."""


def step(
    key: jax.Array,
    state: FilterState,
    view: CanvasView,
    time_ns: int,
    config: SlamConfig,
    odometry: NDArray[np.float64] | None = None,
) -> tuple[FilterState, FrameInfo]:
    """One frame further.

    Args:
        key: consumed.
        state: after the previous frame.
        view: the frame.
        time_ns: its stamp.
        config: settings.
        odometry: (4, 4) previous_from_camera by KISS-ICP, where it is used and not degenerate.
    """
    prediction = predict(state, time_ns)
    found, unexpected = find_pose_hypotheses(state, view, prediction, config, odometry)
    if state.calibration.frames == 0 and found[0].group >= 0:
        state = with_calibration(state, found[0])
        found, unexpected = find_pose_hypotheses(state, view, prediction, config, odometry)
    components = _components(found, state, prediction.poses)
    population, info, proposed = _advance(
        key,
        state.population,
        jnp.asarray(state.keyframe_poses[:, np.asarray(components.keyframes)]),
        prediction.poses,
        jnp.asarray(prediction.groups, jnp.int32),
        components,
        state.motion,
        state.calibration.noise,
        state.calibration.exponent,
        config.ess_threshold,
    )
    lost = found[0].group < 0
    known = len(state.keyframe_map)
    moved = replace(
        state,
        population=population,
        keyframe_poses=state.keyframe_poses[np.asarray(info.ancestors)]
        if info.resampled
        else state.keyframe_poses,
        times_ns=(state.times_ns[1], time_ns),
        was_lost=lost,
    )
    doubt = CERTAIN
    if not lost and config.second_motion:
        best = found[0]
        anchor = int(best.indices[0]), best.local_map.poses[0]
        rival, doubt = doubt_of_frame(state.rival, view, state.calibration, best.optimum.pose, *anchor)
        moved = replace(moved, rival=rival)
    if not lost:
        moved = with_frame(moved, view, found, doubt)
    report = frame_info(moved, known, view, info, proposed, components, found, lost, unexpected, doubt)
    turned = state.steps_were_wide or turns_wide(*last_motion(population))
    return replace(moved, steps_were_wide=turned), report


def _components(found: list[Registration], state: FilterState, predictions: jax.Array) -> Component:
    """The optima as components, stacked (J, ...), J padded to a bucket with components for nobody."""
    particles: CameraParticles = state.population.particles
    heaviest = int(jnp.argmax(state.population.log_weights))
    history = MotionHistory(particles.pose[heaviest], predictions[heaviest], particles.pivot[heaviest])
    components = [
        component_at(
            located.optimum,
            located.local_map.poses,
            jnp.asarray(located.indices, jnp.int32),
            jnp.asarray(located.group, jnp.int32),
            history,
            state.motion,
            state.calibration.exponent,
        )
        for located in found
    ]
    room = next(bucket for bucket in COMPONENT_BUCKETS if bucket >= len(components))
    unused = replace(components[0], group=jnp.asarray(-1, jnp.int32))
    components += [unused] * (room - len(components))
    return stacked(*components)


@partial(jax.jit, static_argnames="ess_threshold")
def _advance(
    key: jax.Array,
    population: smc.Population,
    compared: jax.Array,
    predictions: jax.Array,
    groups: jax.Array,
    components: Component,
    motion: MotionPrior,
    noise: DepthNoise,
    exponent: float,
    ess_threshold: float,
) -> tuple[smc.Population, smc.StepInfo, Proposed]:
    """The generic step with this frame's proposal; returns the new population and the draws.

    `compared` are poses (K, J, M, 7) of the components' keyframes.
    """
    count = len(population.log_weights)

    def propose(
        key: jax.Array, extended: tuple[CameraParticles, jax.Array, jax.Array, jax.Array]
    ) -> tuple[tuple[CameraParticles, Proposed], jax.Array]:
        particles, own, ahead, group = extended
        history = MotionHistory(particles.pose, ahead, particles.pivot)
        keys = jax.random.split(key, count)
        proposed, log_increments = propose_all(keys, own, group, history, components, motion, noise, exponent)
        moved = replace(particles, pose=proposed.pose, previous_pose=particles.pose)
        return (moved, proposed), log_increments

    extended = smc.Population((population.particles, compared, predictions, groups), population.log_weights)
    extended, info = smc.step(key, extended, propose, ess_threshold)
    particles, proposed = extended.particles
    return smc.Population(particles, extended.log_weights), info, proposed


def frame_info(
    state: FilterState,
    known_keyframes: int,
    view: CanvasView,
    info: smc.StepInfo,
    proposed: Proposed,
    components: Component,
    found: list[Registration],
    lost: bool,
    unexpected: bool,
    doubt: Doubt,
) -> FrameInfo:
    """Of a frame after its step.

    Args:
        state: after it.
        known_keyframes: number of keyframes before it.
        view: the frame.
        info: of the generic step.
        proposed: the draws.
        components: of the proposal.
        found: optima, as by `slam.filter.pose_hypotheses.find_pose_hypotheses`.
        lost: whether there was none.
        unexpected: whether none was found where the camera was expected.
        doubt: what a second motion leaves open.
    """
    anchor = int(found[0].indices[0])
    anchors = jnp.asarray(state.keyframe_poses[:, anchor])
    means, scales = proposed.conditional_mean, np.asarray(components.scale)
    covariances = scales @ scales.transpose(0, 2, 1)
    if lost:
        means = jnp.tile(state.last_found, (len(anchors), 1))
        spread = spread_around(state.last_found, proposed.pose, state.population.log_weights)
        covariances = np.tile(spread, (len(scales), 1, 1))
    is_keyframe = len(state.keyframe_map) > known_keyframes
    following = np.zeros((6, NODES), np.float32)
    if not (lost or is_keyframe):
        following = np.asarray(_field_sensitivity(state, view, found[0], jnp.asarray(covariances[0])))
    return FrameInfo(
        anchor=anchor,
        relative_poses=np.asarray(_relative(anchors, proposed.pose)),
        relative_means=np.asarray(_relative(anchors, means)),
        component=np.asarray(proposed.component),
        component_covariances=covariances,
        field_sensitivity=following,
        ties=_ties(components, found[0], is_followed=not (lost or is_keyframe)),
        log_weights=np.asarray(state.population.log_weights),
        ancestors=np.asarray(info.ancestors),
        log_evidence=float(info.log_evidence),
        ess=float(info.ess),
        resampled=bool(info.resampled),
        lost=lost,
        unexpected=unexpected,
        explained=found[0].explained,
        covered=found[0].covered,
        keyframes=len(state.keyframe_map),
        is_keyframe=is_keyframe,
        components=0 if lost else len(found),
        doubt=doubt,
    )


def _ties(components: Component, best: Registration, is_followed: bool) -> Ties:
    """Of the first component, the best optimum's."""
    if not is_followed:
        return Ties.none(len(best.indices))
    means = _from_keyframes(components.mean_keyframe_poses, components.pose)
    return Ties(*(np.asarray(leaf)[0] for leaf in (components.keyframes, means, components.sensitivity)))


@jax.jit
def _from_keyframes(keyframes: jax.Array, cameras: jax.Array) -> jax.Array:
    """keyframe_from_camera (J, M, 7) of keyframes (J, M, 7) and cameras (J, 7)."""

    def one(keyframe: jax.Array, camera: jax.Array) -> jax.Array:
        return (jaxlie.SE3(keyframe).inverse() @ jaxlie.SE3(camera)).wxyz_xyz

    return jax.vmap(jax.vmap(one, (0, None)))(keyframes, cameras)


def _field_sensitivity(
    state: FilterState, view: CanvasView, located: Registration, covariance: jax.Array
) -> jax.Array:
    """Of the frame's best optimum, whose tempered covariance (6, 6) that is."""
    calibration, nodes = state.calibration, NodeWeights.of(view)
    tempered = calibration.exponent * covariance
    return field_sensitivity(located.optimum, located.local_map, view, nodes, calibration.noise, tempered)


@jax.jit
def _relative(anchors: jax.Array, poses: jax.Array) -> jax.Array:
    """anchor_from_camera (K, 7)."""

    def one(anchor: jax.Array, pose: jax.Array) -> jax.Array:
        return (jaxlie.SE3(anchor).inverse() @ jaxlie.SE3(pose)).wxyz_xyz

    return jax.vmap(one)(anchors, poses)
