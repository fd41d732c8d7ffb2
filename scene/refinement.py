"""How well an object's pose is known given the rest of the scene.

Adaptive importance sampling (population Monte Carlo, Cappe et al. 2004): a Gaussian round each pose of the
best scene is drawn from, weighted by the likelihood at a temperature that keeps enough draws alive, and
fitted anew, for all objects side by side. It gives the chains' proposals.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from recordings.types import DepthNoise
from scene.initialisation import Initialisation
from scene.likelihood import DepthEvidence, depth_evidence, log_likelihood_ratio
from scene.rendering import ObjectRenderer
from scene.scene_data import SceneData
from shapes.camera import Camera
from shapes.ray_casting import PosedObjects

DRAWS, TURNS = 192, 6
ALIVE = 40.0
"""Effective number of draws to which a turn is tempered."""
FIRST_SIGMA = np.repeat([0.004, 0.05], 3)
LEAST_SIGMA = np.repeat([0.0001, 0.002], 3)
WIDER = 1.15
BISECTIONS = 14


@dataclass(frozen=True, kw_only=True, eq=False)
class Refinement:
    """Gaussians on the poses of N objects, offset in the camera and turn of the box.

    Attributes:
        poses: (N, 7) camera_from_box, the best seen.
        means: (N, 7) camera_from_box.
        covariances: (N, 6, 6).
        visible_fraction: (N,) share of the object's pixels that nothing hides.
    """

    poses: NDArray[np.float64]
    means: NDArray[np.float64]
    covariances: NDArray[np.float64]
    visible_fraction: NDArray[np.float64]


def refine(
    key: jax.Array,
    data: SceneData,
    renderer: ObjectRenderer,
    numbers: NDArray[np.integer],
    start: Initialisation,
    noise: DepthNoise,
    pixel_weight: float,
) -> Refinement:
    """Gaussians round the poses of the best scene, on the first frame.

    Args:
        key: random key.
        data: the first frame.
        renderer: of these objects and others.
        numbers: (N,) of the objects among the renderer's.
        start: the best scene.
        noise: of the sensor and the surfaces together.
        pixel_weight: the likelihood's exponent.
    """
    count = len(start.poses)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    means = start.poses
    factors = np.tile(np.diag(FIRST_SIGMA), (count, 1, 1))
    best, visible = start.poses, np.zeros(count)
    for _ in range(TURNS):
        rest_m, visible = _without_each(data, renderer, numbers, means, start.found)
        normal = rng.standard_normal((count, DRAWS, 6))
        normal[:, 0] = 0.0
        tangents = np.einsum("nij,nsj->nsi", factors, normal)
        poses = np.asarray(_moved(means, tangents), np.float64)
        log_ratio = pixel_weight * _log_ratio(data, renderer, numbers, poses, rest_m, noise)
        log_weights = log_ratio + 0.5 * (normal**2).sum(axis=-1)
        weights = np.stack([_tempered(one) for one in log_weights])
        top = log_ratio.argmax(axis=1)
        best = poses[np.arange(count), top]
        steps = np.einsum("ns,nsi->ni", weights, tangents)
        spread = tangents - steps[:, None]
        covariances = np.einsum("ns,nsi,nsj->nij", weights, spread, spread) + np.diag(LEAST_SIGMA**2)
        means = np.asarray(_moved(means, steps[:, None]), np.float64)[:, 0]
        factors = WIDER * np.linalg.cholesky(covariances)
    return Refinement(
        poses=best,
        means=means,
        covariances=factors @ np.swapaxes(factors, 1, 2),
        visible_fraction=visible,
    )


def _tempered(log_weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Normalised weights (S,) to the largest power up to 1 that leaves ALIVE effective draws."""

    def alive(power: float) -> float:
        return float(1 / (softmax(power * log_weights) ** 2).sum())

    if alive(1.0) >= ALIVE:
        return softmax(log_weights)
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if alive(middle) >= ALIVE else (low, middle)
    return softmax(low * log_weights)


def _without_each(
    data: SceneData,
    renderer: ObjectRenderer,
    numbers: NDArray[np.integer],
    poses: NDArray[np.float64],
    found: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Depth (N, H, W) of the scene without each object, and the share (N,) of each that it does not hide."""
    count = len(poses)
    depth = renderer.layers(numbers, poses, data.window)
    depth = np.where(found[:, None, None], depth, np.float32(np.inf))
    others = [np.delete(depth, one, axis=0).min(axis=0, initial=np.inf) for one in range(count)]
    rest_m = np.minimum(np.stack(others), data.rest_m)
    covers = np.isfinite(depth)
    shown = covers & (depth <= rest_m)
    return rest_m.astype(np.float32), shown.sum(axis=(1, 2)) / np.maximum(covers.sum(axis=(1, 2)), 1)


def _log_ratio(
    data: SceneData,
    renderer: ObjectRenderer,
    numbers: NDArray[np.integer],
    poses: NDArray[np.float64],
    rest_m: NDArray[np.float32],
    noise: DepthNoise,
) -> NDArray[np.float64]:
    """Log likelihood ratio (N, S) of the image with each object at poses (N, S, 7) and without it."""
    count, draws = poses.shape[:2]
    places = np.repeat(np.arange(count, dtype=np.int32), draws)
    objects = np.asarray(numbers, np.int32)[places]
    flat = poses.reshape(-1, 7).astype(np.float32)
    camera, observed_m = data.window.camera, data.window.depth_m
    evidence, posed = _posed_before_rests(renderer, noise, camera, observed_m, rest_m, places, objects, flat)
    ratio = log_likelihood_ratio(renderer.library, noise, evidence, posed)
    return ratio.astype(np.float64).reshape(count, draws)


@jax.jit
def _posed_before_rests(
    renderer: ObjectRenderer,
    noise: DepthNoise,
    camera: Camera,
    observed_m: jax.Array,
    rest_m: jax.Array,
    places: jax.Array,
    objects: jax.Array,
    poses: jax.Array,
) -> tuple[DepthEvidence, PosedObjects]:
    """The image against rests (N, H, W), and objects (M,) at poses (M, 7), each before its place's rest."""
    cameras = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, len(rest_m)), camera)
    evidence = depth_evidence(noise, cameras, observed_m[None], rest_m)
    return evidence, renderer.posed(objects, poses, places)


@jax.jit
def _moved(poses: jax.Array, steps: jax.Array) -> jax.Array:
    """Poses (N, S, 7) from poses (N, 7) by steps (N, S, 6)."""

    def move(pose: jax.Array, step: jax.Array) -> jax.Array:
        turned = jaxlie.SO3(pose[:4]) @ jaxlie.SO3.exp(step[3:])
        return jnp.concatenate([turned.normalize().wxyz, pose[4:] + step[:3]])

    return jax.vmap(jax.vmap(move, in_axes=(None, 0)))(poses, steps)
