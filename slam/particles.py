"""What a camera particle owns, and how a group of them is averaged."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from slam import pose_gaussian

IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CameraParticles:
    """K trajectories, as far as the future depends on them. Poses are wxyz_xyz, reference_from_*.

    Attributes:
        keyframe_poses: (K, N, 7), identity where the map has no keyframe yet.
        pose: (K, 7) of the last frame.
        previous_pose: (K, 7) of the frame before.
        pivot: (K, 3) what an orbit looks at, in the reference frame, metres.
    """

    keyframe_poses: jax.Array
    pose: jax.Array
    previous_pose: jax.Array
    pivot: jax.Array


def initial_particles(count: int, capacity: int, pivot: NDArray[np.float32]) -> CameraParticles:
    """Every camera at the reference, which is the first keyframe."""
    identity = jnp.asarray(IDENTITY, jnp.float32)
    poses = jnp.tile(identity, (count, 1))
    return CameraParticles(
        keyframe_poses=jnp.tile(identity, (count, capacity, 1)),
        pose=poses,
        previous_pose=poses,
        pivot=jnp.tile(jnp.asarray(pivot, jnp.float32), (count, 1)),
    )


def with_capacity(particles: CameraParticles, capacity: int) -> CameraParticles:
    """The same particles with room for `capacity` keyframes."""
    count, used, _ = particles.keyframe_poses.shape
    room = jnp.tile(jnp.asarray(IDENTITY, jnp.float32), (count, capacity - used, 1))
    poses = jnp.concatenate([particles.keyframe_poses, room], axis=1)
    return CameraParticles(poses, particles.pose, particles.previous_pose, particles.pivot)


def mean_and_covariance(
    poses: jax.Array,
    weights: jax.Array,
    covariances: jax.Array | None = None,
    central: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Mean (7,) and covariance (6, 6) of weighted poses (K, 7), in the chart at the mean.

    With the conditional covariances (K, 6, 6) of the particles, theirs is added (the law of total
    covariance). The mean is the fixed point of averaging chart coordinates. Where weights of `central`
    particles (K,) are given, it is theirs, and the covariance the second moment of all around it.
    """
    of_mean = weights if central is None else central

    def average(mean: jax.Array, _: None) -> tuple[jax.Array, None]:
        tangents = jax.vmap(pose_gaussian.coordinates, (None, 0))(mean, poses)
        return pose_gaussian.displaced(mean, of_mean @ tangents), None

    mean, _ = jax.lax.scan(average, poses[jnp.argmax(of_mean)], None, length=3)
    tangents = jax.vmap(pose_gaussian.coordinates, (None, 0))(mean, poses)
    between = jnp.einsum("k,ki,kj->ij", weights, tangents, tangents)
    if covariances is None:
        return mean, between
    return mean, between + jnp.einsum("k,kij->ij", weights, covariances)


@jax.jit
def mean_keyframes(poses: jax.Array, weights: jax.Array) -> jax.Array:
    """Means (N, 7) of keyframe poses (K, N, 7) over weighted particles (K,)."""
    return jax.vmap(mean_and_covariance, (1, None))(poses, weights)[0]


GROUP_SHIFT_M = 0.1
GROUP_ANGLE_RAD = 0.1
MOST_GROUPS = 4
LEAST_GROUP_WEIGHT = 1e-3


def within_reach(
    one: NDArray[np.float64],
    other: NDArray[np.float64],
    shift_m: float = GROUP_SHIFT_M,
    angle_rad: float = GROUP_ANGLE_RAD,
) -> NDArray[np.bool_]:
    """Whether (...) poses (..., 4, 4) stand within a shift and a turn of each other."""
    relative = np.linalg.inv(one) @ other
    cosine = 0.5 * (np.trace(relative[..., :3, :3], axis1=-2, axis2=-1) - 1)
    return (np.linalg.norm(relative[..., :3, 3], axis=-1) < shift_m) & (cosine > np.cos(angle_rad))


def grouped(poses: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.int_]:
    """Group (K,) of each particle by its pose (K, 4, 4), or by all of its poses (K, N, 4, 4).

    Group 0 holds the heaviest. Particles join the first leader within reach, leaders being the heaviest
    particles. Groups of negligible weight, and all beyond `MOST_GROUPS`, join group 0: a search for them
    would be wasted.
    """
    groups = np.full(len(poses), -1)
    count = 0
    for leader in np.argsort(-weights, kind="stable"):
        if groups[leader] >= 0:
            continue
        near = within_reach(poses[leader], poses)
        members = near.reshape(len(poses), -1).all(axis=1) & (groups < 0)
        members[leader] = True
        negligible = weights[members].sum() < LEAST_GROUP_WEIGHT or count == MOST_GROUPS
        groups[members] = 0 if count and negligible else count
        count += not (count and negligible)
    return groups
