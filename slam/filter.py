"""The camera filter: `init` on the first frame, `step` on each further one.

A step finds local optima of the frame's density (`slam.localisation`), turns them into a mixture
proposal (`slam.proposal`), runs the generic step of sequential Monte Carlo on it (`slam.smc`), and
lets the frame refine the map or become a keyframe of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from slam import pose_gaussian, smc
from slam.config import SlamConfig
from slam.depth_view import DepthView
from slam.enumeration import local_grid
from slam.fusion import fused
from slam.keyframe_map import KeyframeMap, selected_keyframes
from slam.keyframes import surface_of, with_planes_refitted
from slam.localisation import LocalMap, Optimum, local_optimum
from slam.motion import FreeMotion, MotionHistory, MotionPrior, OrbitMotion
from slam.particles import IDENTITY, CameraParticles, initial_particles, mean_and_covariance, with_capacity
from slam.proposal import Component, Proposed, propose_all

CAPACITY_STEP = 32
DEFAULT_EXPONENT = 0.1
KEYFRAME_SHIFT = 0.1
"""A frame whose camera moved this far from every keyframe, in median scene depths, becomes one."""
KEYFRAME_ANGLE_RAD = 0.2
KEYFRAME_COVERAGE = 0.75
LEAST_COVERED = 0.1
LEAST_EXPLAINED = 0.5
"""Of the returns that meet the map, the share that must lie on it for a frame to count as found."""


@dataclass(frozen=True)
class FilterState:
    """What is carried from frame to frame.

    Attributes:
        population: weighted `CameraParticles`.
        keyframe_map: shared surfaces.
        noise: the sensor.
        exponent: tempering of the image density.
        motion: prior over motion.
        times_ns: stamps of the last two frames.
        active: index of the keyframe that the last found frame was closest to.
    """

    population: smc.Population
    keyframe_map: KeyframeMap
    noise: DepthNoise
    exponent: float
    motion: MotionPrior
    times_ns: tuple[int, int]
    active: int


@dataclass(frozen=True)
class FrameInfo:
    """What one frame gave. Poses are relative to the particle's keyframe `anchor`.

    Attributes:
        anchor: index of a keyframe.
        relative_poses: (K, 7) anchor_from_camera, each particle's draw.
        relative_means: (K, 7) the same, centres of the components that the draws came from.
        component_covariance: (6, 6) of the draws around their centres, camera chart.
        log_weights: (K,) normalised, after this frame.
        ancestors: (K,) particle before this frame that each one continues.
        log_evidence: increment.
        ess: after weighting.
        resampled: whether particles were drawn anew.
        lost: whether no pose agreed with the map.
        explained: share of returns on the map's surface.
        covered: share of returns that meet the map.
    """

    anchor: int
    relative_poses: NDArray[np.float32]
    relative_means: NDArray[np.float32]
    component_covariance: NDArray[np.float32]
    log_weights: NDArray[np.float32]
    ancestors: NDArray[np.int32]
    log_evidence: float
    ess: float
    resampled: bool
    lost: bool
    explained: float
    covered: float


def init(view: DepthView, time_ns: int, config: SlamConfig) -> tuple[FilterState, FrameInfo]:
    """The state after the first frame, which is the reference and the first keyframe."""
    depth = np.asarray(view.depth_m)
    radius = config.orbit_radius_m or _central_depth(depth)
    motion: MotionPrior = FreeMotion.default()
    if config.motion == "orbit":
        loose = None if config.orbit_radius_m else 0.15 * radius
        motion = OrbitMotion.default() if loose is None else OrbitMotion.of_unknown_radius(loose)
    noise = config.noise or DepthNoise()
    surface = _surface_of(view, noise)
    pivot = np.asarray([0.0, 0.0, radius], np.float32)
    particles = initial_particles(config.particles, CAPACITY_STEP, pivot)
    state = FilterState(
        population=smc.uniform_population(particles),
        keyframe_map=KeyframeMap().with_keyframe(surface),
        noise=noise,
        exponent=config.effective_pixel_share or DEFAULT_EXPONENT,
        motion=motion,
        times_ns=(time_ns, time_ns),
        active=0,
    )
    return state, _first_frame_info(config.particles)


def _first_frame_info(count: int) -> FrameInfo:
    """The reference itself: certain, and no evidence for or against anything."""
    at_anchor = np.tile(np.asarray(IDENTITY, np.float32), (count, 1))
    return FrameInfo(
        anchor=0,
        relative_poses=at_anchor,
        relative_means=at_anchor,
        component_covariance=np.zeros((6, 6), np.float32),
        log_weights=np.full(count, -np.log(count), np.float32),
        ancestors=np.arange(count, dtype=np.int32),
        log_evidence=0.0,
        ess=float(count),
        resampled=False,
        lost=False,
        explained=1.0,
        covered=1.0,
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
    state = _with_room(state)
    particles: CameraParticles = state.population.particles
    ratio = _velocity_ratio(state.times_ns, time_ns)
    predicted = _predicted(particles, ratio)
    weights = jnp.exp(state.population.log_weights)
    pose, _ = _mean(particles.pose, weights)
    ahead, _ = _mean(predicted, weights)
    starts = [ahead, pose]
    if odometry is not None:
        starts.append(_composed(pose, odometry))
    starts += [ahead] * (3 - len(starts))
    indices, local_map = _local_map(state, ahead, view, config, weights)
    optimum = local_optimum(local_map, view, state.noise, jnp.stack(starts), jnp.asarray(local_grid()))
    explained, covered = float(optimum.agreement.explained), float(optimum.agreement.covered)
    lost = covered < LEAST_COVERED or explained < LEAST_EXPLAINED * covered
    history = MotionHistory(pose, ahead, particles.pivot[0])
    group = -1 if lost else 0
    component = _component(optimum, local_map, indices, group, history, state.motion, state.exponent)
    population, info, proposed = _advance(
        key,
        state.population,
        predicted,
        component,
        state.motion,
        state.noise,
        state.exponent,
        config.ess_threshold,
    )
    anchor = int(indices[0])
    frame_info = _frame_info(population, info, proposed, component, anchor, lost, explained, covered)
    state = replace(state, population=population, times_ns=(state.times_ns[1], time_ns), active=anchor)
    if not lost:
        state = _with_frame_in_map(state, view, optimum.pose, local_map.poses[0], anchor, covered)
    return state, frame_info


def _velocity_ratio(times_ns: tuple[int, int], time_ns: int) -> float:
    """The coming interval in units of the last one; zero where there is none, at most three."""
    last = times_ns[1] - times_ns[0]
    return float(np.clip((time_ns - times_ns[1]) / last, 0.0, 3.0)) if last > 0 else 0.0


@jax.jit
def _predicted(particles: CameraParticles, ratio: float) -> jax.Array:
    def one(previous: jax.Array, pose: jax.Array) -> jax.Array:
        return pose_gaussian.displaced(pose, ratio * pose_gaussian.coordinates(previous, pose))

    return jax.vmap(one)(particles.previous_pose, particles.pose)


_mean = jax.jit(mean_and_covariance)


def _composed(pose: jax.Array, matrix: NDArray[np.float64]) -> jax.Array:
    step = jaxlie.SE3.from_matrix(jnp.asarray(matrix, jnp.float32))
    return (jaxlie.SE3(pose) @ step).wxyz_xyz


def _matrices(poses: jax.Array) -> NDArray[np.float64]:
    return np.asarray(jaxlie.SE3(poses).as_matrix(), np.float64)


def _local_map(
    state: FilterState, ahead: jax.Array, view: DepthView, config: SlamConfig, weights: jax.Array
) -> tuple[NDArray[np.int_], LocalMap]:
    """Indices (M,) of the keyframes to compare with, padded, and the group's mean map of them."""
    particles: CameraParticles = state.population.particles
    used = len(state.keyframe_map)
    best = particles.keyframe_poses[jnp.argmax(weights), :used]
    camera = view.camera
    extent = np.argwhere(np.asarray(view.measured)).max(axis=0) + 1
    intrinsics = np.asarray([camera.fx, camera.fy, camera.cx, camera.cy, extent[1], extent[0]], np.float64)
    chosen = selected_keyframes(
        state.keyframe_map, _matrices(best), _matrices(ahead), intrinsics, config.keyframes_compared
    )
    present = np.arange(config.keyframes_compared) < len(chosen)
    indices = np.where(present, np.resize(chosen, config.keyframes_compared), chosen[0])
    poses = _mean_keyframes(particles.keyframe_poses[:, indices], weights)
    return indices, LocalMap(state.keyframe_map.stacked(indices), jnp.asarray(present), poses)


@jax.jit
def _mean_keyframes(poses: jax.Array, weights: jax.Array) -> jax.Array:
    return jax.vmap(mean_and_covariance, (1, None))(poses, weights)[0]


@jax.jit
def _component(
    optimum: Optimum,
    local_map: LocalMap,
    indices: jax.Array,
    group: int,
    history: MotionHistory,
    motion: MotionPrior,
    exponent: float,
) -> Component:
    """The optimum of image density times prior, as a Gaussian that follows the keyframes."""

    def residual(xi: jax.Array) -> jax.Array:
        return motion.whitened_residual(history, pose_gaussian.displaced(optimum.pose, xi))

    zero = jnp.zeros(6, jnp.float32)
    jacobian, offset = jax.jacfwd(residual)(zero), residual(zero)
    precision = exponent * optimum.layer_precisions.sum(0) + jacobian.T @ jacobian
    covariance = jnp.linalg.inv(precision)
    covariance = 0.5 * (covariance + covariance.T)
    sensitivity = jnp.einsum("ij,mjk->mik", covariance, exponent * optimum.layer_precisions)
    return Component(
        pose=pose_gaussian.displaced(optimum.pose, -covariance @ jacobian.T @ offset),
        scale=jnp.linalg.cholesky(covariance),
        sensitivity=sensitivity,
        log_score=exponent * optimum.log_density,
        group=jnp.asarray(group, jnp.int32),
        keyframes=indices,
        mean_keyframe_poses=local_map.poses,
        pixels=optimum.pixels,
    )


@partial(jax.jit, static_argnames="ess_threshold")
def _advance(
    key: jax.Array,
    population: smc.Population,
    predicted: jax.Array,
    component: Component,
    motion: MotionPrior,
    noise: DepthNoise,
    exponent: float,
    ess_threshold: float,
) -> tuple[smc.Population, smc.StepInfo, Proposed]:
    """The generic step with this frame's proposal; returns the new population and the draws."""
    components = jax.tree.map(lambda leaf: leaf[None], component)

    def propose(
        key: jax.Array, extended: tuple[CameraParticles, jax.Array]
    ) -> tuple[tuple[CameraParticles, Proposed], jax.Array]:
        particles, ahead = extended
        count = len(particles.pose)
        history = MotionHistory(particles.pose, ahead, particles.pivot)
        group = jnp.zeros(count, jnp.int32)
        proposed, log_increments = propose_all(
            jax.random.split(key, count),
            particles.keyframe_poses,
            group,
            history,
            components,
            motion,
            noise,
            exponent,
        )
        moved = replace(particles, pose=proposed.pose, previous_pose=particles.pose)
        return (moved, proposed), log_increments

    extended = smc.Population((population.particles, predicted), population.log_weights)
    extended, info = smc.step(key, extended, propose, ess_threshold)
    particles, proposed = extended.particles
    return smc.Population(particles, extended.log_weights), info, proposed


def _frame_info(
    population: smc.Population,
    info: smc.StepInfo,
    proposed: Proposed,
    component: Component,
    anchor: int,
    lost: bool,
    explained: float,
    covered: float,
) -> FrameInfo:
    particles: CameraParticles = population.particles
    anchors = particles.keyframe_poses[:, anchor]
    draws, means = _relative(anchors, proposed.pose), _relative(anchors, proposed.conditional_mean)
    covariance = np.zeros((6, 6), np.float32) if lost else np.asarray(component.scale @ component.scale.T)
    return FrameInfo(
        anchor=anchor,
        relative_poses=np.asarray(draws),
        relative_means=np.asarray(means),
        component_covariance=covariance,
        log_weights=np.asarray(population.log_weights),
        ancestors=np.asarray(info.ancestors),
        log_evidence=float(info.log_evidence),
        ess=float(info.ess),
        resampled=bool(info.resampled),
        lost=lost,
        explained=explained,
        covered=covered,
    )


@jax.jit
def _relative(anchors: jax.Array, poses: jax.Array) -> jax.Array:
    """anchor_from_camera (K, 7)."""
    return jax.vmap(lambda anchor, pose: (jaxlie.SE3(anchor).inverse() @ jaxlie.SE3(pose)).wxyz_xyz)(
        anchors, poses
    )


def _with_room(state: FilterState) -> FilterState:
    """The state with room for one keyframe more in every particle."""
    particles: CameraParticles = state.population.particles
    capacity = particles.keyframe_poses.shape[1]
    if len(state.keyframe_map) < capacity:
        return state
    population = replace(state.population, particles=with_capacity(particles, capacity + CAPACITY_STEP))
    return replace(state, population=population)


_fused = jax.jit(fused)
_refitted = jax.jit(with_planes_refitted)
_surface_of = jax.jit(surface_of)


def _with_frame_in_map(
    state: FilterState, view: DepthView, pose: jax.Array, anchor_pose: jax.Array, anchor: int, covered: float
) -> FilterState:
    """The frame refines its anchor, or, seen from elsewhere, becomes a keyframe at each particle's pose."""
    relative = (jaxlie.SE3(anchor_pose).inverse() @ jaxlie.SE3(pose)).wxyz_xyz
    shift = float(jnp.linalg.norm(relative[4:]))
    angle = float(jnp.linalg.norm(jaxlie.SE3(relative).rotation().log()))
    far = shift > KEYFRAME_SHIFT * _central_depth(np.asarray(view.depth_m)) or angle > KEYFRAME_ANGLE_RAD
    keyframe_map = state.keyframe_map
    if not far and covered >= KEYFRAME_COVERAGE:
        refined = _fused(keyframe_map.surfaces[anchor], view, relative, state.noise)
        return replace(state, keyframe_map=keyframe_map.with_refined(anchor, refined))
    refitted = _refitted(keyframe_map.surfaces[anchor])
    keyframe_map = keyframe_map.with_refined(anchor, refitted)
    index = len(keyframe_map)
    particles: CameraParticles = state.population.particles
    keyframe_poses = particles.keyframe_poses.at[:, index].set(particles.pose)
    population = replace(state.population, particles=replace(particles, keyframe_poses=keyframe_poses))
    return replace(
        state,
        population=population,
        keyframe_map=keyframe_map.with_keyframe(_surface_of(view, state.noise)),
        active=index,
    )


def _central_depth(depth_m: NDArray[np.float32]) -> float:
    """Median depth of the image's middle ninth, or of all of it, or 1 m where nothing was measured."""
    rows, columns = depth_m.shape
    middle = depth_m[rows // 3 : 2 * rows // 3, columns // 3 : 2 * columns // 3]
    for region in (middle, depth_m):
        if (region > 0).any():
            return float(np.median(region[region > 0]))
    return 1.0
