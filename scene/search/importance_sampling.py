"""Poses of objects given the rest of the scene, refined before scenes that are about as good are compared.

Adaptive importance sampling (population Monte Carlo, Cappe et al. 2004): a Gaussian round the pose of each
object is sampled, weighted by the likelihood at a temperature that keeps enough draws alive, and fitted
again, all objects in parallel.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from recordings.types import DepthNoise
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.one_object import DepthEvidence, depth_evidence, log_likelihood_ratio
from scene.observation.frame_data import SceneData
from shapes.geometry.camera import Camera
from shapes.rendering.ray_casting import PosedObjects

APART_M, APART_RAD = 0.01, 0.175
"""Poses that are closer belong to one mode."""

DRAWS, TOGETHER, TURNS = 96, 4, 5
"""Draws from a Gaussian and turn, and Gaussians in one kernel."""

PIXEL_WEIGHT = 0.25
"""Exponent of the sensor's density, which takes neighbouring pixels for independent. Gaussians are where the
search goes on, so that it has no part in what chains and search compare."""

ALIVE = 30.0
"""Effective number of draws to which a turn is tempered."""

FIRST_SIGMA = np.repeat([0.004, 0.05], 3)
"""Standard deviations of offsets (metres) and turns (radians) in the first turn, ..."""

LEAST_SIGMA = np.repeat([0.0001, 0.002], 3)
"""... and those that are added to what draws tell, for few of them may lie in a plane."""

WIDER = 1.15
"""Factor of fitted standard deviations: proposals should reach beyond what they are fitted to."""

BISECTIONS = 30
"""Of the power to which weights are tempered: to 1e-9."""


def refine(
    key: jax.Array,
    data: SceneData,
    renderer: ObjectRenderer,
    numbers: NDArray[np.integer],
    poses: NDArray[np.float64],
    found: NDArray[np.bool_],
    moving: NDArray[np.bool_],
    noise: DepthNoise,
) -> NDArray[np.float64]:
    """Poses (N, 7) camera_from_box of a scene, refined on one frame.

    Args:
        key: random key.
        data: the frame.
        renderer: of these objects and others.
        numbers: (N,) of the objects among the renderer's.
        poses: (N, 7) where they are.
        found: (N,) which are in the scene.
        moving: (N,) which are refined. The others stay where they are.
        noise: of the sensor and the surfaces together.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    active, window = np.flatnonzero(moving), data.window
    means, factors = np.array(poses), np.tile(np.diag(FIRST_SIGMA), (len(poses), 1, 1))
    for _ in range(TURNS):
        rest_m = _without_each(data, renderer, numbers, means, found)
        for first in range(0, len(active), TOGETHER):
            mine = np.resize(active[first : first + TOGETHER], TOGETHER)
            normal = rng.standard_normal((TOGETHER, DRAWS, 6))
            normal[:, 0] = 0.0
            tangents = np.einsum("nij,nsj->nsi", factors[mine], normal)
            drawn = np.asarray(_moved(means[mine], tangents), np.float64)
            places = np.repeat(mine.astype(np.int32), DRAWS)
            which, flat = np.asarray(numbers, np.int32)[places], drawn.reshape(-1, 7).astype(np.float32)
            evidence, posed = _posed_before_rests(
                renderer, noise, window.camera, window.depth_m, rest_m, places, which, flat
            )
            ratio = log_likelihood_ratio(renderer.library, noise, evidence, posed)
            log_weights = PIXEL_WEIGHT * ratio.astype(np.float64).reshape(TOGETHER, DRAWS)
            log_weights += 0.5 * (normal**2).sum(axis=-1)
            steps, factors[mine] = _gaussians(tangents, log_weights)
            means[mine] = np.asarray(_moved(means[mine], steps[:, None]), np.float64)[:, 0]
    return means


def _without_each(
    data: SceneData,
    renderer: ObjectRenderer,
    numbers: NDArray[np.integer],
    poses: NDArray[np.float64],
    found: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Depth (N, H, W) of the scene without each object."""
    depth = renderer.layers(numbers, poses, data.window)
    depth = np.where(found[:, None, None], depth, np.float32(np.inf))
    others = [np.delete(depth, one, axis=0).min(axis=0, initial=np.inf) for one in range(len(poses))]
    return np.minimum(np.stack(others), data.rest_m).astype(np.float32)


def distinct(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Those of poses (S, 7) that are `APART_M` or `APART_RAD` from all before."""
    sites = poses[:1]
    for pose in poses[1:]:
        angle = 2 * np.arccos(np.minimum(np.abs(sites[:, :4] @ pose[:4]), 1.0))
        offset = np.linalg.norm(sites[:, 4:] - pose[4:], axis=1)
        if ((angle > APART_RAD) | (offset > APART_M)).all():
            sites = np.append(sites, pose[None], axis=0)
    return sites


def _gaussians(
    tangents: NDArray[np.float64], log_weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means (J, 6) and lower factors (J, 6, 6) of weighted draws (J, S, 6)."""
    steps, covariances = moments(tangents, np.stack([tempered(one, ALIVE) for one in log_weights]))
    factors = WIDER * np.linalg.cholesky(covariances + np.diag(LEAST_SIGMA**2))
    return steps, np.asarray(factors, np.float64)


def moments(
    steps: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means (n, d) and covariances (n, d, d) of steps (n, S, d) by their weights (n, S)."""
    means = np.asarray(np.einsum("ns,nsi->ni", weights, steps), np.float64)
    spread = steps - means[:, None]
    return means, np.asarray(np.einsum("ns,nsi,nsj->nij", weights, spread, spread), np.float64)


def tempered(log_weights: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """Normalised weights (S,) to the largest power up to 1 that leaves so many effective draws."""
    return softmax(largest_power(log_weights, least) * log_weights)


def largest_power(log_weights: NDArray[np.float64], least: float, most: float = 1.0) -> float:
    """Power over 0 and up to `most` of weights (S,) that leaves so many effective draws of them."""

    def alive(power: float) -> float:
        return float(1 / (softmax(power * log_weights) ** 2).sum())

    if alive(most) >= least:
        return most
    low, high = 0.0, most
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if alive(middle) >= least else (low, middle)
    return high


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
