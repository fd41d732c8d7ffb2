"""Joint refinement of all keyframes: the optimum of their overlaps as a Metropolis-Hastings proposal.

The filter places a keyframe once, by the few it sees at that moment and at working resolution; errors add up
along the way. Here every keyframe's image at full detail is compared with the surfaces of all keyframes that
it overlaps (`slam.overlap`), and the graph of these overlaps is brought to its optimum by Gauss-Newton, each
overlap linearised anew in every round. The target is the overlap density, tempered so that a pixel which
several surfaces explain counts once. Particles that have the keyframes in the same places are one mode, and
each mode has an optimum of its own. The proposal carries the mode's mean over to the optimum, which is its
own inverse and keeps volumes, so that the density ratio alone decides. (Asked particle by particle it was
refused at random: densities at single draws differ by tens of nats.) Moved or not, a mode's particles then
forget the filter's drift: they draw their displacement from the mean by the graph's Gaussian, the Laplace
approximation of the same density (MATH.md J). What is told of keyframes is that Gaussian itself (`Placed`): a
few dozen draws, of which the weights may leave two or three, have no spread in most directions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from shapes.poses import matrices_of
from slam import keyframe_kernels, pose_graph
from slam.depth_view import DepthView, framing
from slam.filter_state import FilterState
from slam.keyframe_map import KeyframeMap, selected_keyframes
from slam.keyframe_motion import KeyframeMotion
from slam.overlap import (
    PlaneImage,
    PointSample,
    log_overlap_densities,
    overlap_terms,
    sampled,
)
from slam.particles import CameraParticles, grouped, mean_keyframes
from slam.plane_fitting import region_planes
from slam.pose_graph import PoseGraph
from slam.whole_planes import with_whole_planes

OVERLAPS = 6
"""Earlier keyframes with which each one is compared, both ways round."""
INFLATIONS = (4.0, 3.0, 2.0, 1.5)
"""Of sigma in the first rounds, which start at the filter's drift."""
MOST_STEPS = 8
"""After those."""
DAMPING = 1e4
"""A step of a centimetre along what no pixel sees weighs as much as one standard deviation."""
CONVERGED = 0.05
"""Gain of a step, in tempered nats, as a share of what noise itself costs at the optimum: half a nat for each
coordinate. In a bare room further steps lead away, centimetres along the walls, for nothing (measured)."""
HELD_INFLATIONS, HELD_DAMPING, HELD_CONVERGED = (1.0,), 100.0, 0.002
"""The same where the motion prior holds what no pixel sees. It is not to outweigh what they see: few samples
of inflated sigma say less of rotations than it does, so that all are asked from the first round on."""
FARTHEST = 0.05
"""Metres or radians. A keyframe that would move farther is not near its optimum: the filter mistook the
place, or nothing holds it. It stays, and the others are refined without it."""
LEAST_INLIERS = 60.0
THINNED = 8
"""Of the samples, every so many decide on the first rounds: they stand for all."""
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

    @cached_property
    def surface(self) -> PlaneImage:
        """With planes where regions have one."""
        return PlaneImage.of(self.view, jnp.where((self.region_sizes > 0)[None], self.planes, 0.0))

    @cached_property
    def sample(self) -> PointSample:
        """On the host, where stacking is cheap."""
        return jax.tree.map(np.asarray, sampled(self.view, self.planes, self.region_sizes))

    def with_whole_planes(self, noise: DepthNoise) -> Detail:
        """The same with large planes as one each."""
        planes = with_whole_planes(np.asarray(self.planes), np.asarray(self.region_sizes), self.view, noise)
        return replace(self, planes=jnp.asarray(planes))


def detail_of(view: DepthView, noise: DepthNoise) -> Detail:
    """A keyframe seen on `FINE_CANVAS`."""
    return Detail(view, *region_planes(view, noise))


@dataclass(frozen=True, kw_only=True)
class Keyframes:
    """Keyframes at full detail, and which of them overlap.

    Attributes:
        surfaces: N.
        samples: N, on the host.
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


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class Placed:
    """Where the modes have the keyframes, before the particles (K,) drew theirs.

    Attributes:
        mode: (K,) index into the modes, -1 for particles of one whose keyframes nothing holds together.
        poses: (G, N, 7) reference_from_keyframe.
        covariances: (G, N, 6, 6) in the charts there.
        held: (G, N) keyframes that overlaps tie to the first; the others are where the particles had them.
    """

    mode: jax.Array
    poses: jax.Array
    covariances: jax.Array
    held: jax.Array


def refined(
    key: jax.Array,
    state: FilterState,
    details: Sequence[Detail],
    noise: DepthNoise,
    motion: KeyframeMotion | None = None,
) -> tuple[FilterState, Placed | None]:
    """The state with every particle's keyframes after one Metropolis-Hastings step, and where that led.

    None where no keyframes overlap.

    Args:
        key: consumed.
        state: after the last frame.
        details: of the keyframes.
        noise: the sensor at that detail.
        motion: prior of the keyframes' poses, where it is to have a say.
    """
    particles: CameraParticles = state.population.particles
    used = len(state.keyframe_map)
    poses = np.array(particles.keyframe_poses)
    weights = np.exp(np.asarray(state.population.log_weights, np.float64))
    modes = grouped(matrices_of(poses[:, :used]), weights)
    of_particle = np.full(len(modes), -1, np.int32)
    placed: list[tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_]]] = []
    for mode in range(modes.max() + 1):
        members = modes == mode
        share = jnp.asarray(np.where(members, weights, 0.0) / weights[members].sum())
        filtered = np.asarray(mean_keyframes(particles.keyframe_poses, share))[:used]
        keyframes = keyframes_at(state.keyframe_map, details, matrices_of(filtered), noise)
        inflations = INFLATIONS if motion is None else HELD_INFLATIONS
        found = optimum(keyframes, filtered, inflations, motion=motion)
        if found is None:
            continue
        centres, graph, exponents = found
        draw_key, choice_key = jax.random.split(jax.random.fold_in(key, mode))
        before, after = _log_densities(keyframes, np.stack([filtered, centres]), exponents)
        if motion is not None:
            before, after = (
                log_density + motion.log_density(matrices_of(poses))
                for log_density, poses in ((before, filtered), (after, centres))
            )
        if np.log(float(jax.random.uniform(choice_key))) >= after - before:
            centres = filtered
        held = pose_graph.tied_to_first(graph)
        displacements = pose_graph.draws(draw_key, graph, len(modes))
        drawn = keyframe_kernels.drawn(centres, displacements)
        poses[:, :used] = np.where((members[:, None] & held)[..., None], drawn, poses[:, :used])
        of_particle[members] = len(placed)
        placed.append((centres, pose_graph.marginals(graph), held))
    if not placed:
        return state, None
    moved = replace(particles, keyframe_poses=jnp.asarray(poses))
    population = replace(state.population, particles=moved)
    centres, covariances, held = zip(*placed, strict=True)
    return replace(state, population=population), Placed(
        mode=jnp.asarray(of_particle),
        poses=jnp.asarray(np.stack(centres)),
        covariances=jnp.asarray(np.stack(covariances), jnp.float32),
        held=jnp.asarray(np.stack(held)),
    )


def keyframes_at(
    keyframe_map: KeyframeMap, details: Sequence[Detail], poses: NDArray[np.float64], noise: DepthNoise
) -> Keyframes:
    """The keyframes with those overlaps that they have at poses (N, 4, 4)."""
    overlap = np.zeros((len(details), len(details)), bool)
    for second in range(1, len(details)):
        before = KeyframeMap(surfaces=keyframe_map.surfaces[:second], samples=keyframe_map.samples[:second])
        frame = framing(details[second].view)
        overlap[second, selected_keyframes(before, poses[:second], poses[second], frame, OVERLAPS)] = True
    return Keyframes(
        surfaces=[detail.surface for detail in details],
        samples=[detail.sample for detail in details],
        images_of=[np.nonzero(row)[0] for row in overlap | overlap.T],
        noise=noise,
    )


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


def optimum(
    keyframes: Keyframes,
    poses: NDArray[np.float32],
    inflations: Sequence[float] = INFLATIONS,
    farthest: float = FARTHEST,
    motion: KeyframeMotion | None = None,
) -> tuple[NDArray[np.float32], PoseGraph, NDArray[np.float64]] | None:
    """Poses (N, 7) at the optimum near `poses`, the tempered graph there and each image's exponent (N,).

    None where no keyframes overlap. `inflations` and `farthest` as `INFLATIONS` and `FARTHEST`; with `motion`
    the overlaps are tempered in every step, and damped less: it holds what they do not see.
    """
    start, astray = poses, np.zeros(len(poses), bool)
    linearised = _linearised(keyframes, poses, inflations[0], astray)
    damping, converged = (DAMPING, CONVERGED) if motion is None else (HELD_DAMPING, HELD_CONVERGED)
    for round_ in range(1, len(inflations) + MOST_STEPS):
        if linearised is None:
            return None
        tempered = _tempered(linearised, motion, poses)
        step = pose_graph.damped_step(linearised.graph if motion is None else tempered, damping)
        if round_ > len(inflations) and _gain(tempered, step) < converged * 0.5 * step[1:].size:
            break
        poses = keyframe_kernels.displaced(poses, step)
        astray |= np.abs(keyframe_kernels.coordinates(start, poses)).max(axis=1) > farthest
        poses = np.where(astray[:, None], start, poses)
        inflation = inflations[round_] if round_ < len(inflations) else 1.0
        linearised = _linearised(keyframes, poses, inflation, astray)
    if linearised is None:
        return None
    return poses, _tempered(linearised, motion, poses), _exponents(linearised)


def _tempered(
    linearised: _Linearised, motion: KeyframeMotion | None, poses: NDArray[np.float32]
) -> PoseGraph:
    """The graph with its terms to the power of their exponents, and the motion prior at poses (N, 7)."""
    graph = linearised.graph
    exponents = _exponents(linearised)[graph.pairs[:, 0]]
    return replace(
        graph,
        precision=graph.precision * exponents[:, None, None],
        gradient=graph.gradient * exponents[:, None],
        joint=None if motion is None else motion.bent(matrices_of(poses)),
    )


def _linearised(
    keyframes: Keyframes, poses: NDArray[np.float32], inflation: float, astray: NDArray[np.bool_]
) -> _Linearised | None:
    """Overlaps that agree at all; keyframes that are `astray` (N,) have no part in it. None without any."""
    stride = 1 if inflation == 1.0 else THINNED
    overlaps, parts = [], []
    for surface, samples, index, images in keyframes.batches(stride):
        relative = _relative(poses[index], poses[np.resize(images, IMAGE_BUCKET)])
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


def _gain(graph: PoseGraph, step: NDArray[np.float64]) -> float:
    """Nats by which a Newton step (N, 6) raises the density: half its squared decrement."""
    displaced = step[graph.pairs].reshape(-1, 12)
    joint = 0.0 if graph.joint is None else step.ravel() @ graph.joint.precision @ step.ravel()
    return float(0.5 * (np.einsum("ei,eij,ej->", displaced, graph.precision, displaced) + joint))


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
    keyframes: Keyframes, poses: NDArray[np.float32], exponents: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Tempered log densities (L,) of all overlaps at keyframes (L, N, 7)."""
    total = np.zeros(len(poses))
    for surface, samples, index, images in keyframes.batches(1):
        padded = np.resize(images, IMAGE_BUCKET)
        relative = _relative_by_image(poses[:, index], poses[:, padded])
        densities = log_overlap_densities(surface, samples, relative, keyframes.noise)
        total += exponents[images] @ np.asarray(densities, np.float64)[: len(images)]
    return total


@jax.jit
def _relative(origin: jax.Array, poses: jax.Array) -> jax.Array:
    """origin_from_pose (n, 7) of one pose (7,) and others (n, 7)."""
    inverse = jaxlie.SE3(origin).inverse()
    return jax.vmap(lambda pose: (inverse @ jaxlie.SE3(pose)).wxyz_xyz)(poses)


@jax.jit
def _relative_by_image(origins: jax.Array, poses: jax.Array) -> jax.Array:
    """origin_from_pose (n, L, 7) of L poses (L, 7) and of n others each (L, n, 7)."""
    return jax.vmap(_relative)(origins, poses).swapaxes(0, 1)
