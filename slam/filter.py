"""The camera filter: `init` on the first frame, `step` on each further one.

A step finds local optima of the frame's density (`slam.search`), turns them into a mixture proposal
(`slam.proposal`), runs the generic step of sequential Monte Carlo on it (`slam.smc`), and lets the
frame refine the map or become a keyframe of it.
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
from shapes.poses import matrices_of
from slam import enumeration, pose_gaussian, smc
from slam.calibration import Calibration
from slam.config import SlamConfig
from slam.depth_view import DepthView, central_depth
from slam.filter_state import FilterState, FrameInfo
from slam.keyframe_map import KeyframeMap
from slam.keyframes import surface_of
from slam.map_update import CAPACITY_STEP, with_calibration, with_frame, with_room
from slam.motion import FreeMotion, MotionHistory, MotionPrior, OrbitMotion
from slam.particles import (
    IDENTITY,
    CameraParticles,
    grouped,
    initial_particles,
    mean_and_covariance,
)
from slam.proposal import Component, Proposed, component_at, propose_all
from slam.rigid import single_precision_poses
from slam.search import GroupMap, Located, Searcher, distinct_places, worth_keeping
from slam.second_look import is_wide

COMPONENT_BUCKETS = (1, 2, 4, 8)
PREDICTION_HOLD = 0.01
"""`PixelTerms.held_step`'s hold at a trusted prediction."""
LONGEST_RATIO = 3.0
LOOSE_RADIUS = 0.15
"""Relative standard deviation of an orbit's radius that nobody gave."""


def init(view: DepthView, time_ns: int, config: SlamConfig) -> tuple[FilterState, FrameInfo]:
    """The state after the first frame, which is the reference and the first keyframe."""
    radius = config.orbit_radius_m or central_depth(view)
    motion: MotionPrior = FreeMotion.default()
    if config.motion == "orbit":
        known = config.orbit_radius_m is not None
        motion = OrbitMotion.default() if known else OrbitMotion.of_unknown_radius(LOOSE_RADIUS * radius)
    calibration = Calibration.initial(config.noise, config.effective_pixel_share)
    pivot = np.asarray([0.0, 0.0, radius], np.float32)
    particles = initial_particles(config.particles, CAPACITY_STEP, pivot)
    state = FilterState(
        population=smc.uniform_population(particles),
        keyframe_map=KeyframeMap().with_keyframe(surface_of(view, calibration.noise)),
        calibration=calibration,
        motion=motion,
        times_ns=(time_ns, time_ns),
        last_found=jnp.asarray(IDENTITY, jnp.float32),
        was_lost=False,
        steps_were_wide=False,
    )
    return state, _first_frame_info(config.particles)


def before_the_map(key: jax.Array, state: FilterState) -> FrameInfo:
    """A frame before the first that shows anything: lost, anywhere that the motion prior leads from there.

    Args:
        key: consumed.
        state: after the first frame that does, by `init`.
    """
    count = len(state.population.log_weights)
    poses = _moved_unseen(jax.random.split(key, count), state)
    spread = _spread_around(jnp.asarray(IDENTITY, jnp.float32), poses, state.population.log_weights)
    return replace(
        _first_frame_info(count),
        relative_poses=np.asarray(poses),
        component_covariances=np.asarray(spread)[None],
        lost=True,
        explained=0.0,
        covered=0.0,
        keyframe=None,
    )


def _moved_unseen(keys: jax.Array, state: FilterState) -> jax.Array:
    """Poses (K, 7), each a step of the motion prior from that of the particle."""
    particles: CameraParticles = state.population.particles

    def one(key: jax.Array, pose: jax.Array, pivot: jax.Array) -> jax.Array:
        return state.motion.sample(key, MotionHistory(pose, pose, pivot))

    return jax.vmap(one)(keys, particles.pose, particles.pivot)


def _first_frame_info(count: int) -> FrameInfo:
    """The reference itself: certain, and no evidence for or against anything."""
    at_anchor = np.tile(np.asarray(IDENTITY, np.float32), (count, 1))
    return FrameInfo(
        anchor=0,
        relative_poses=at_anchor,
        relative_means=at_anchor,
        component=np.zeros(count, np.int32),
        component_covariances=np.zeros((1, 6, 6), np.float32),
        log_weights=np.full(count, -np.log(count), np.float32),
        ancestors=np.arange(count, dtype=np.int32),
        log_evidence=0.0,
        ess=float(count),
        resampled=False,
        lost=False,
        explained=1.0,
        covered=1.0,
        keyframes=1,
        keyframe=0,
        components=0,
    )


def step(
    key: jax.Array,
    state: FilterState,
    view: DepthView,
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
    state = with_room(state)
    particles: CameraParticles = state.population.particles
    ratio = _velocity_ratio(state.times_ns, time_ns)
    trusted = 0.0 < ratio < LONGEST_RATIO and not state.was_lost
    predicted = _predicted(particles, ratio)
    weights = np.exp(np.asarray(state.population.log_weights, np.float64))
    groups = grouped(matrices_of(particles.pose), weights)
    found = _found(state, view, predicted, groups, weights, config, odometry, trusted)
    if state.calibration.frames == 0 and found[0].group >= 0:
        state = with_calibration(state, found[0])
        found = _found(state, view, predicted, groups, weights, config, odometry, trusted)
    components = _components(found, state, predicted)
    population, info, proposed = _advance(
        key,
        state.population,
        predicted,
        jnp.asarray(groups, jnp.int32),
        components,
        state.motion,
        state.calibration.noise,
        state.calibration.exponent,
        config.ess_threshold,
    )
    lost = found[0].group < 0
    known = len(state.keyframe_map)
    moved = replace(state, population=population, times_ns=(state.times_ns[1], time_ns), was_lost=lost)
    if not lost:
        moved = with_frame(moved, view, found)
    frame_info = _frame_info(moved, known, info, proposed, components, found, lost)
    turned = state.steps_were_wide or is_wide(*_last_step(population))
    return replace(moved, steps_were_wide=turned), frame_info


def _velocity_ratio(times_ns: tuple[int, int], time_ns: int) -> float:
    """The coming interval in units of the last one; zero where there is none, at most `LONGEST_RATIO`."""
    last = times_ns[1] - times_ns[0]
    return float(np.clip((time_ns - times_ns[1]) / last, 0.0, LONGEST_RATIO)) if last > 0 else 0.0


@jax.jit
def _predicted(particles: CameraParticles, ratio: float) -> jax.Array:
    def one(previous: jax.Array, pose: jax.Array) -> jax.Array:
        return pose_gaussian.displaced(pose, ratio * pose_gaussian.coordinates(previous, pose))

    return jax.vmap(one)(particles.previous_pose, particles.pose)


_mean = jax.jit(mean_and_covariance)


def _found(
    state: FilterState,
    view: DepthView,
    predicted: jax.Array,
    groups: NDArray[np.int_],
    weights: NDArray[np.float64],
    config: SlamConfig,
    odometry: NDArray[np.float64] | None,
    trusted: bool,
) -> list[Located]:
    """Optima worth proposing, the best first; a single one of group -1 where the camera is lost.

    Where depth tells nothing of a direction, as along a bare wall, a `trusted` prediction is kept.

    Each group of particles looks near its own prediction. Where none finds a convincing place, or the
    camera was lost and predictions mean little, all look where it was last found, and everywhere; after
    a wide step already where none finds an unmistakable one.
    """
    particles: CameraParticles = state.population.particles
    searcher = Searcher(state.keyframe_map, view, state.calibration.noise, config.keyframes_compared)
    found = []
    hold = PREDICTION_HOLD if trusted else 0.0
    for group in range(0 if state.was_lost else groups.max() + 1):
        group_map = _group_map(state, np.where(groups == group, weights, 0.0), group)
        last = _mean(particles.pose, group_map.weights)[0]
        starts = [] if odometry is None else [single_precision_poses(matrices_of(last) @ odometry)]
        if config.proposal != "kiss" or odometry is None:
            starts = [_mean(predicted, group_map.weights)[0], last, *starts]
        found.append(searcher.near(group_map, starts, hold if len(starts) > 1 else 0.0))
    convincing = [located for located in found if located.is_convincing]
    doubtful = not any(located.is_unmistakable for located in found)
    if not convincing or (doubtful and _step_may_be_wide(state.population)):
        everyone = _group_map(state, weights, 0)
        distances = np.asarray(enumeration.ORBIT_DISTANCES) * central_depth(view)
        found.append(searcher.near(everyone, [state.last_found]))
        found += searcher.anywhere(everyone, state.last_found, distances)
        convincing = [replace(located, group=0) for located in distinct_places(found)]
    kept = worth_keeping(convincing, state.calibration.exponent)
    kept.sort(key=lambda located: -float(located.optimum.log_density))
    return kept[: COMPONENT_BUCKETS[-1]] or [replace(found[0], group=-1)]


def _step_may_be_wide(population: smc.Population) -> bool:
    """Whether the next step may lead to a place that only looks like it: the last one turned far.

    Round an object on a pedestal the last view explains most of the next one, a fifth of a circle on. Of the
    first step nothing is known.
    """
    before, after = _last_step(population)
    return bool(np.array_equal(before, after)) or is_wide(before, after)


def _last_step(population: smc.Population) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (4, 4) of the heaviest particle, in the frame before the last and in the last."""
    particles: CameraParticles = population.particles
    heaviest = int(jnp.argmax(population.log_weights))
    return matrices_of(particles.previous_pose[heaviest]), matrices_of(particles.pose[heaviest])


def _group_map(state: FilterState, weights: NDArray[np.float64], group: int) -> GroupMap:
    particles: CameraParticles = state.population.particles
    used = len(state.keyframe_map)
    share = jnp.asarray(weights / weights.sum(), jnp.float32)
    heaviest = matrices_of(particles.keyframe_poses[int(np.argmax(weights)), :used])
    return GroupMap(particles.keyframe_poses, share, heaviest, group)


def _components(found: list[Located], state: FilterState, predicted: jax.Array) -> Component:
    """The optima as components, stacked (J, ...), J padded to a bucket with components for nobody."""
    particles: CameraParticles = state.population.particles
    heaviest = int(jnp.argmax(state.population.log_weights))
    history = MotionHistory(particles.pose[heaviest], predicted[heaviest], particles.pivot[heaviest])
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
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *components)


@partial(jax.jit, static_argnames="ess_threshold")
def _advance(
    key: jax.Array,
    population: smc.Population,
    predicted: jax.Array,
    groups: jax.Array,
    components: Component,
    motion: MotionPrior,
    noise: DepthNoise,
    exponent: float,
    ess_threshold: float,
) -> tuple[smc.Population, smc.StepInfo, Proposed]:
    """The generic step with this frame's proposal; returns the new population and the draws."""
    count = len(population.log_weights)

    def propose(
        key: jax.Array, extended: tuple[CameraParticles, jax.Array, jax.Array]
    ) -> tuple[tuple[CameraParticles, Proposed], jax.Array]:
        particles, ahead, group = extended
        history = MotionHistory(particles.pose, ahead, particles.pivot)
        keys = jax.random.split(key, count)
        proposed, log_increments = propose_all(
            keys, particles.keyframe_poses, group, history, components, motion, noise, exponent
        )
        moved = replace(particles, pose=proposed.pose, previous_pose=particles.pose)
        return (moved, proposed), log_increments

    extended = smc.Population((population.particles, predicted, groups), population.log_weights)
    extended, info = smc.step(key, extended, propose, ess_threshold)
    particles, proposed = extended.particles
    return smc.Population(particles, extended.log_weights), info, proposed


def _frame_info(
    state: FilterState,
    known_keyframes: int,
    info: smc.StepInfo,
    proposed: Proposed,
    components: Component,
    found: list[Located],
    lost: bool,
) -> FrameInfo:
    particles: CameraParticles = state.population.particles
    anchor = int(found[0].indices[0])
    anchors = particles.keyframe_poses[:, anchor]
    means, scales = proposed.conditional_mean, np.asarray(components.scale)
    covariances = scales @ scales.transpose(0, 2, 1)
    if lost:
        means = jnp.tile(state.last_found, (len(anchors), 1))
        spread = _spread_around(state.last_found, proposed.pose, state.population.log_weights)
        covariances = np.tile(spread, (len(scales), 1, 1))
    return FrameInfo(
        anchor=anchor,
        relative_poses=np.asarray(_relative(anchors, proposed.pose)),
        relative_means=np.asarray(_relative(anchors, means)),
        component=np.asarray(proposed.component),
        component_covariances=covariances,
        log_weights=np.asarray(state.population.log_weights),
        ancestors=np.asarray(info.ancestors),
        log_evidence=float(info.log_evidence),
        ess=float(info.ess),
        resampled=bool(info.resampled),
        lost=lost,
        explained=found[0].explained,
        covered=found[0].covered,
        keyframes=len(state.keyframe_map),
        keyframe=known_keyframes if len(state.keyframe_map) > known_keyframes else None,
        components=0 if lost else len(found),
    )


@jax.jit
def _relative(anchors: jax.Array, poses: jax.Array) -> jax.Array:
    """anchor_from_camera (K, 7)."""

    def one(anchor: jax.Array, pose: jax.Array) -> jax.Array:
        return (jaxlie.SE3(anchor).inverse() @ jaxlie.SE3(pose)).wxyz_xyz

    return jax.vmap(one)(anchors, poses)


@jax.jit
def _spread_around(centre: jax.Array, poses: jax.Array, log_weights: jax.Array) -> jax.Array:
    """Second moment (6, 6) of weighted poses (K, 7) in the chart at `centre` (7,)."""
    tangents = jax.vmap(pose_gaussian.coordinates, (None, 0))(centre, poses)
    return jnp.einsum("k,ki,kj->ij", jnp.exp(log_weights), tangents, tangents)
