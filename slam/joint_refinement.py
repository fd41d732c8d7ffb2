"""Joint refinement of all keyframes: the optimum of their overlaps as a Metropolis-Hastings proposal.

The filter places a keyframe once, by the few it sees at that moment and at working resolution; errors add up
along the way. Here every keyframe's image at full detail is compared with the surfaces of all keyframes that
it overlaps (`slam.overlap`), and the graph of these overlaps is brought to its optimum by Gauss-Newton, each
overlap linearised anew in every round. The target is the overlap density, tempered so that a pixel which
several surfaces explain counts once. The proposal carries a particle's displacement from the filter's mean
over to the optimum, which is its own inverse and keeps volumes, so that the density ratio alone decides.
Particles that moved then forget the filter's drift: they draw their displacement from the graph's Gaussian,
the Laplace approximation of the same density (MATH.md J).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from slam import pose_gaussian, pose_graph
from slam.depth_view import DepthView, framing
from slam.filter_state import FilterState
from slam.keyframe_map import KeyframeMap, selected_keyframes
from slam.overlap import (
    PlaneImage,
    PointSample,
    log_overlap_densities,
    overlap_terms,
    sampled,
)
from slam.particles import CameraParticles, mean_keyframes
from slam.plane_fitting import region_planes
from slam.pose_graph import PoseGraph
from slam.rigid import matrices_of

OVERLAPS = 6
"""Earlier keyframes with which each one is compared, both ways round."""
INFLATIONS = (4.0, 3.0, 2.0, 1.5)
"""Of sigma in the first rounds, which start at the filter's drift."""
MOST_ROUNDS = 12
DAMPING = 1e4
"""A step of a centimetre along what no pixel sees weighs as much as one standard deviation."""
CONVERGED = 1e-4
"""Largest coordinate of a last step, metres or radians."""
FARTHEST = 0.05
"""Metres or radians. A keyframe that would move farther is not near its optimum: the filter mistook the
place, or nothing holds it. It stays, and the others are refined without it."""
LEAST_INLIERS = 60.0
THINNED = 8
"""Of the samples, every so many decide on the first rounds, and on acceptance, which is asked for every
particle: they stand for all."""
IMAGE_BUCKET = 4
"""Images compared with one surface in one call, so that kernels are compiled once."""


@dataclass(frozen=True)
class Detail:
    """A keyframe at full detail: its view, and `region_planes` of it.

    JAX computes in the background: planes are asked for when the keyframe is made, and used at the end.
    """

    view: DepthView
    planes: jax.Array
    region_sizes: jax.Array


def detail_of(view: DepthView, noise: DepthNoise) -> Detail:
    """A keyframe seen on `FINE_CANVAS`."""
    return Detail(view, *region_planes(view, noise))


@dataclass(frozen=True, kw_only=True)
class Keyframes:
    """Keyframes at full detail, and which of them overlap.

    Attributes:
        surfaces: N.
        samples: N, on the host, where stacking them is cheap.
        images_of: for each surface, the keyframes (n,) whose images are compared with it.
        noise: the sensor, at full detail.
    """

    surfaces: Sequence[PlaneImage]
    samples: Sequence[PointSample]
    images_of: Sequence[NDArray[np.int_]]
    noise: DepthNoise

    def batches(self, stride: int) -> Iterator[tuple[PlaneImage, PointSample, int, NDArray[np.int_]]]:
        """Surface, every `stride`-th sample of the images, the surface's index, the images' (n,)."""
        for surface, images in enumerate(self.images_of):
            for first in range(0, len(images), IMAGE_BUCKET):
                chosen = images[first : first + IMAGE_BUCKET]
                padded = [self.samples[int(image)] for image in np.resize(chosen, IMAGE_BUCKET)]
                samples = jax.tree.map(
                    lambda *leaves: np.stack([leaf[:, ::stride] for leaf in leaves]), *padded
                )
                yield self.surfaces[surface], samples, surface, chosen


def refined(key: jax.Array, state: FilterState, details: Sequence[Detail], noise: DepthNoise) -> FilterState:
    """The state with every particle's keyframes after one Metropolis-Hastings step.

    Args:
        key: consumed.
        state: after the last frame.
        details: of the keyframes.
        noise: the sensor at that detail.
    """
    particles: CameraParticles = state.population.particles
    used = len(state.keyframe_map)
    weights = jnp.exp(state.population.log_weights)
    filtered = mean_keyframes(particles.keyframe_poses[:, :used], weights)
    keyframes = _keyframes(state.keyframe_map, details, matrices_of(filtered), noise)
    optimum = _optimum(keyframes, filtered)
    if optimum is None:
        return state
    centres, graph, exponents = optimum
    draw_key, choice_key = jax.random.split(key)
    current = particles.keyframe_poses[:, :used]
    carried = _carried(filtered, centres, current)
    landmarks = jnp.stack([filtered, centres])
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        ahead, behind = pool.map(
            lambda poses: _log_densities(keyframes, poses, landmarks, exponents), (carried, current)
        )
    log_ratio = ahead - behind
    accepted = jnp.log(jax.random.uniform(choice_key, (len(current),))) < log_ratio
    displacements = pose_graph.draws(draw_key, graph, len(current))
    drawn = _drawn(centres, jnp.asarray(displacements, jnp.float32))
    moved = jnp.where(accepted[:, None, None], drawn, current)
    keyframe_poses = particles.keyframe_poses.at[:, :used].set(moved)
    population = replace(state.population, particles=replace(particles, keyframe_poses=keyframe_poses))
    return replace(state, population=population)


def _keyframes(
    keyframe_map: KeyframeMap, details: Sequence[Detail], poses: NDArray[np.float64], noise: DepthNoise
) -> Keyframes:
    surfaces, samples = [], []
    for detail in details:
        view, flat = detail.view, (detail.region_sizes > 0)[None]
        surfaces.append(PlaneImage(view.depth_m, jnp.where(flat, detail.planes, 0.0), view.rays, view.camera))
        samples.append(jax.tree.map(np.asarray, sampled(view, detail.planes, detail.region_sizes)))
    overlap = np.zeros((len(details), len(details)), bool)
    for second in range(1, len(details)):
        before = KeyframeMap(surfaces=keyframe_map.surfaces[:second], samples=keyframe_map.samples[:second])
        frame = framing(details[second].view)
        overlap[second, selected_keyframes(before, poses[:second], poses[second], frame, OVERLAPS)] = True
    images_of = [np.nonzero(row)[0] for row in overlap | overlap.T]
    return Keyframes(surfaces=surfaces, samples=samples, images_of=images_of, noise=noise)


@dataclass(frozen=True, kw_only=True)
class _Linearised:
    """The graph of E overlaps, its pairs being (image, surface), and what tells how much to believe it.

    Attributes:
        graph: not tempered.
        score_variance: (E, 12, 12) of the gradients.
        inliers: (E,).
    """

    graph: PoseGraph
    score_variance: NDArray[np.float64]
    inliers: NDArray[np.float64]


def _optimum(
    keyframes: Keyframes, poses: jax.Array
) -> tuple[jax.Array, PoseGraph, NDArray[np.float64]] | None:
    """Poses (N, 7) at the optimum near `poses`, the tempered graph there and each image's exponent (N,).

    None where no keyframes overlap.
    """
    start, astray = poses, np.zeros(len(poses), bool)
    linearised = _linearised(keyframes, poses, INFLATIONS[0], astray)
    for round_ in range(1, MOST_ROUNDS):
        if linearised is None:
            return None
        step = pose_graph.damped_step(linearised.graph, DAMPING)
        poses = _displaced(poses, jnp.asarray(step, jnp.float32))
        astray |= np.abs(np.asarray(_coordinates(start, poses))).max(axis=1) > FARTHEST
        poses = jnp.where(astray[:, None], start, poses)
        if round_ > len(INFLATIONS) and np.abs(step[~astray]).max() < CONVERGED:
            break
        inflation = INFLATIONS[round_] if round_ < len(INFLATIONS) else 1.0
        linearised = _linearised(keyframes, poses, inflation, astray)
    if linearised is None:
        return None
    exponents = _exponents(linearised)
    graph = linearised.graph
    tempered = graph.precision * exponents[graph.pairs[:, 0], None, None]
    return poses, replace(graph, precision=tempered), exponents


def _linearised(
    keyframes: Keyframes, poses: jax.Array, inflation: float, astray: NDArray[np.bool_]
) -> _Linearised | None:
    """Overlaps that agree at all; keyframes that are `astray` (N,) have no part in it. None without any."""
    stride = 1 if inflation == 1.0 else THINNED
    overlaps, parts = [], []
    placed = np.asarray(poses)
    for surface, samples, index, images in keyframes.batches(stride):
        relative = _relative(placed[index], placed[np.resize(images, IMAGE_BUCKET)])
        terms = overlap_terms(surface, samples, relative, keyframes.noise, inflation)
        parts.append([np.asarray(leaf, np.float64)[: len(images)] for leaf in jax.tree.leaves(terms)])
        overlaps.append(np.stack([images, np.full(len(images), index)], axis=1))
    if not parts:
        return None
    pairs = np.concatenate(overlaps)
    precision, gradient, score_variance, inliers = (np.concatenate(leaf) for leaf in zip(*parts, strict=True))
    agree = (stride * inliers > LEAST_INLIERS) & ~astray[pairs].any(axis=1)
    if not agree.any():
        return None
    graph = PoseGraph(
        keyframes=len(poses), pairs=pairs[agree], precision=precision[agree], gradient=gradient[agree]
    )
    return _Linearised(graph=graph, score_variance=score_variance[agree], inliers=inliers[agree])


def _exponents(linearised: _Linearised) -> NDArray[np.float64]:
    """Exponent (N,) of each image's densities: its pixels count once, and as many as are independent.

    An image's inliers over those of its largest overlap tell by how many surfaces a pixel is explained; the
    spread of the blocks' scores, how much of the curvature is repetition (`slam.calibration`).
    """
    graph, images = linearised.graph, linearised.graph.pairs[:, 0]
    total, largest = np.zeros(graph.keyframes), np.ones(graph.keyframes)
    np.add.at(total, images, linearised.inliers)
    np.maximum.at(largest, images, linearised.inliers)
    of_image = graph.precision[:, :6, :6]
    floor = 1e-6 * np.trace(of_image, axis1=1, axis2=2)[:, None, None] * np.eye(6)
    repetition = np.linalg.solve(of_image + floor, linearised.score_variance[:, :6, :6])
    inflation = max(1.0, float(np.median(np.trace(repetition, axis1=1, axis2=2) / 6)))
    return 1.0 / (np.maximum(1.0, total / largest) * inflation)


def _log_densities(
    keyframes: Keyframes, poses: jax.Array, landmarks: jax.Array, exponents: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Tempered log densities (K,) of all overlaps at keyframes (K, N, 7), of pixels seen from (L, N, 7)."""
    total = np.zeros(len(poses))
    placed = np.asarray(poses), np.asarray(landmarks)
    for surface, samples, index, images in keyframes.batches(THINNED):
        padded = np.resize(images, IMAGE_BUCKET)
        relative, fixed = (_relative_by_image(several[:, index], several[:, padded]) for several in placed)
        densities = log_overlap_densities(surface, samples, relative, fixed, keyframes.noise)
        total += THINNED * exponents[images] @ np.asarray(densities, np.float64)[: len(images)]
    return total


@jax.jit
def _relative(origin: jax.Array, poses: jax.Array) -> jax.Array:
    """origin_from_pose (n, 7) of one pose (7,) and others (n, 7)."""
    inverse = jaxlie.SE3(origin).inverse()
    return jax.vmap(lambda pose: (inverse @ jaxlie.SE3(pose)).wxyz_xyz)(poses)


@jax.jit
def _relative_by_image(origins: jax.Array, poses: jax.Array) -> jax.Array:
    """origin_from_pose (n, K, 7) of K poses (K, 7) and of n others each (K, n, 7)."""
    return jax.vmap(_relative)(origins, poses).swapaxes(0, 1)


_displaced = jax.jit(jax.vmap(pose_gaussian.displaced))
_coordinates = jax.jit(jax.vmap(pose_gaussian.coordinates))


@jax.jit
def _carried(origin: jax.Array, target: jax.Array, poses: jax.Array) -> jax.Array:
    """Poses (K, N, 7) with the displacements from `target` (N, 7) that they have from `origin` (N, 7)."""

    def one(origin: jax.Array, target: jax.Array, pose: jax.Array) -> jax.Array:
        return pose_gaussian.displaced(target, pose_gaussian.coordinates(origin, pose))

    return jax.vmap(jax.vmap(one), (None, None, 0))(origin, target, poses)


@jax.jit
def _drawn(centres: jax.Array, displacements: jax.Array) -> jax.Array:
    """Poses (K, N, 7) displaced by (K, N, 6) from centres (N, 7)."""
    return jax.vmap(jax.vmap(pose_gaussian.displaced), (None, 0))(centres, displacements)
