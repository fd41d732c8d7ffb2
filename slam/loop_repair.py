"""Loop repair: the pose graph's optimum as a Metropolis-Hastings proposal for every particle's keyframes.

The filter places a keyframe once, by the few it sees at that moment; errors add up along the way. Here every
keyframe is aligned with each of several that it overlaps, and the graph of these alignments is solved. The
target is the overlap density: each keyframe's image given each overlapping surface alone, tempered so that
every image counts once. The proposal carries a particle's displacement from the filter's mean over to the
optimum, which is its own inverse and keeps volumes, so that the density ratio alone decides. Particles that
moved then forget the filter's drift: they draw their displacement from the graph's Gaussian, the Laplace
approximation of the same density (MATH.md J).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from slam import pose_gaussian, pose_graph
from slam.alignment import STIFFNESS
from slam.depth_view import DepthView, framing
from slam.filter import FilterState
from slam.image_density import ScoredPixels, log_image_density
from slam.keyframe_map import KeyframeMap, selected_keyframes
from slam.keyframes import Surface
from slam.particles import IDENTITY, CameraParticles, mean_keyframes
from slam.pose_graph import GraphOptimum, PoseGraph
from slam.rigid import matrices_of, poses_of
from slam.search import GroupMap, Located, Searcher

OVERLAPS = 4
"""Earlier keyframes with which each one is aligned."""


@dataclass(frozen=True, kw_only=True)
class Overlap:
    """Keyframe `second` seen as an image of the surface of keyframe `first`.

    Attributes:
        first: index of the surface.
        second: index of the image.
        located: the image's optimum in the frame of `first`.
    """

    first: int
    second: int
    located: Located


def repaired(key: jax.Array, state: FilterState, compared: int) -> FilterState:
    """The state with every particle's keyframes after one Metropolis-Hastings step of the pose graph.

    Args:
        key: consumed.
        state: after the last frame.
        compared: keyframes that the filter compared a frame with; the same kernels serve here.
    """
    particles: CameraParticles = state.population.particles
    used, noise = len(state.keyframe_map), state.calibration.noise
    weights = jnp.exp(state.population.log_weights)
    filtered = mean_keyframes(particles.keyframe_poses[:, :used], weights)
    overlaps = _overlaps(state.keyframe_map, matrices_of(filtered), noise, compared)
    if not overlaps:
        return state
    graph_key, choice_key = jax.random.split(key)
    shares = _shares(overlaps, float(state.calibration.exponent))
    graph = _graph(overlaps, shares)
    best = pose_graph.optimum(graph_key, graph, matrices_of(filtered), len(weights))
    moved = _moved(choice_key, particles, filtered, best, overlaps, shares, noise)
    keyframe_poses = particles.keyframe_poses.at[:, :used].set(moved)
    population = replace(state.population, particles=replace(particles, keyframe_poses=keyframe_poses))
    return replace(state, population=population)


def _overlaps(
    keyframe_map: KeyframeMap, poses: NDArray[np.float64], noise: DepthNoise, compared: int
) -> list[Overlap]:
    """Convincing alignments of every keyframe with those before it that show most of what it shows."""
    at_origin = GroupMap(jnp.asarray([[IDENTITY]], jnp.float32), jnp.ones(1), np.eye(4)[None], 0)
    found = []
    for second in range(1, len(keyframe_map)):
        view = _view_of(keyframe_map.surfaces[second])
        before = KeyframeMap(surfaces=keyframe_map.surfaces[:second], samples=keyframe_map.samples[:second])
        for first in selected_keyframes(before, poses[:second], poses[second], framing(view), OVERLAPS):
            relative = np.linalg.inv(poses[first]) @ poses[second]
            searcher = Searcher(_only(keyframe_map, int(first)), view, noise, compared)
            located = searcher.near(at_origin, [poses_of(relative)])
            if located.is_convincing:
                found.append(Overlap(first=int(first), second=second, located=located))
    return found


def _only(keyframe_map: KeyframeMap, index: int) -> KeyframeMap:
    chosen = slice(index, index + 1)
    return KeyframeMap(surfaces=keyframe_map.surfaces[chosen], samples=keyframe_map.samples[chosen])


def _view_of(surface: Surface) -> DepthView:
    """A keyframe's refined depth as an image."""
    return DepthView(surface.depth_m, surface.measured, surface.rays, surface.camera)


def _shares(overlaps: list[Overlap], exponent: float) -> NDArray[np.float64]:
    """Exponent (E,) of each overlap: an image that several surfaces explain counts once in all."""
    times = np.bincount([overlap.second for overlap in overlaps])
    return exponent / times[[overlap.second for overlap in overlaps]]


def _graph(overlaps: list[Overlap], shares: NDArray[np.float64]) -> PoseGraph:
    optima = [overlap.located.optimum for overlap in overlaps]
    precision = np.stack([np.asarray(one.layer_precisions.sum(0), np.float64) for one in optima])
    floor = STIFFNESS * np.eye(6)
    return PoseGraph(
        first=np.asarray([overlap.first for overlap in overlaps]),
        second=np.asarray([overlap.second for overlap in overlaps]),
        measured=np.stack([np.asarray(one.pose) for one in optima]),
        precision=shares[:, None, None] * 0.5 * (precision + precision.transpose(0, 2, 1)) + floor,
    )


def _moved(
    key: jax.Array,
    particles: CameraParticles,
    filtered: jax.Array,
    best: GraphOptimum,
    overlaps: list[Overlap],
    shares: NDArray[np.float64],
    noise: DepthNoise,
) -> jax.Array:
    """Keyframes (K, N, 7) of every particle, at the optimum where the overlap density lets it go there."""
    current = particles.keyframe_poses[:, : len(filtered)]
    centres = poses_of(best.poses)
    carried = _carried(filtered, centres, current)
    log_ratio = np.zeros(len(current))
    for overlap, share in zip(overlaps, shares, strict=True):
        pixels, pair = overlap.located.optimum.pixels, np.asarray([overlap.first, overlap.second])
        log_ratio += np.asarray(_log_ratio(pixels, current[:, pair], carried[:, pair], noise, share))
    accepted = jnp.log(jax.random.uniform(key, (len(current),))) < log_ratio
    drawn = _drawn(centres, jnp.asarray(best.draws, jnp.float32))
    return jnp.where(accepted[:, None, None], drawn, current)


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


@jax.jit
def _log_ratio(
    pixels: ScoredPixels, current: jax.Array, proposed: jax.Array, noise: DepthNoise, share: float
) -> jax.Array:
    """Log ratio (K,) of one overlap's density at proposed to that at current pairs of poses (K, 2, 7)."""

    def log_density(pair: jax.Array) -> jax.Array:
        relative = (jaxlie.SE3(pair[0]).inverse() @ jaxlie.SE3(pair[1])).wxyz_xyz
        return log_image_density(pixels, jnp.tile(relative, (len(pixels.planes), 1)), noise, share)

    return jax.vmap(log_density)(proposed) - jax.vmap(log_density)(current)
