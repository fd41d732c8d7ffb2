"""What samples of a scene say: means, covariances, modes, edges, presence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from scene.config import ParseConfig
from scene.depth_images import DepthImages
from scene.graph import floating_scene
from scene.initialisation import Initialisation
from scene.model import SceneModel
from scene.poses import composed, matrix_of, pose_of
from scene.result import SceneResult
from scene.scene_object import SceneObject

MODES = 4
MODE_RADIUS_M, MODE_RADIUS_RAD = 0.02, 0.5
MEAN_STEPS = 5


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Samples:
    """Kept states of chains: (S, ...) once thinned, any leading axes before.

    Attributes:
        poses: (..., C, 7) world_from_box.
        parents: (..., C).
        parent_faces: (..., C).
        child_faces: (..., C).
        log_posterior: (...).
    """

    poses: jax.Array
    parents: jax.Array
    parent_faces: jax.Array
    child_faces: jax.Array
    log_posterior: jax.Array

    @classmethod
    def thinned(cls, blocks: Sequence[Samples], burn_in: int, thinning: int) -> Samples:
        """Every `thinning`-th state after `burn_in`; blocks are (count, chains, ...), the result too."""
        joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *blocks)
        burn_in = min(burn_in, len(joined.log_posterior) - 1)
        return jax.tree.map(lambda leaf: leaf[burn_in::thinning], joined)


def summarise(
    samples: Samples,
    model: SceneModel,
    start: Initialisation,
    world_from_camera: NDArray[np.float64],
    objects: Sequence[SceneObject],
    frames: NDArray[np.int64],
    config: ParseConfig,
) -> SceneResult:
    """The result in the first camera and in the objects' own frames."""
    count = len(objects)
    kept, chains = samples.log_posterior.shape
    flat = jax.tree.map(lambda leaf: leaf.reshape(kept * chains, *leaf.shape[2:]), samples)
    camera = pose_of(jnp.asarray(np.linalg.inv(world_from_camera)))
    offsets = jnp.stack([jnp.asarray([1.0, 0, 0, 0, *(-one.centre_m)]) for one in objects])

    def in_camera(pose: jax.Array, offset: jax.Array) -> jax.Array:
        return composed(camera, composed(pose, offset))

    poses = jax.vmap(jax.vmap(in_camera), in_axes=(0, None))(flat.poses[:, :count], offsets)
    best = jax.vmap(composed)(jnp.asarray(start.poses), offsets)
    means, covariances = jax.vmap(_moments, in_axes=(1, 0))(poses, best)
    modes = [_modes(np.asarray(poses[:, one])) for one in range(count)]
    edges, faces = _edges(flat, model, count)
    presence, visible = _presence(model, start, world_from_camera, count, config)
    return SceneResult(
        names=np.array([one.name for one in objects]),
        frames=np.asarray(frames, np.int64),
        camera_from_object=np.asarray(jax.vmap(matrix_of)(best)),
        mean=np.asarray(jax.vmap(matrix_of)(means)),
        covariance=np.asarray(covariances),
        presence=presence,
        visible_fraction=visible,
        mode_poses=np.stack([poses for poses, _ in modes]),
        mode_probabilities=np.stack([shares for _, shares in modes]),
        edge_probabilities=edges,
        edge_faces=faces,
        sample_poses=np.asarray(poses),
        sample_parents=np.asarray(flat.parents[:, :count], np.int32),
        sample_log_posteriors=np.asarray(flat.log_posterior),
        chain=np.tile(np.arange(chains, dtype=np.int32), kept),
    )


@jax.jit
def _moments(poses: jax.Array, best: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean (7,) and covariance (6, 6) in the right tangent of the samples (S, 7) in the mode of `best`."""
    tangents = jax.vmap(lambda pose: (jaxlie.SE3(best).inverse() @ jaxlie.SE3(pose)).log())(poses)
    near = (jnp.linalg.norm(tangents[:, :3], axis=1) < MODE_RADIUS_M) & (
        jnp.linalg.norm(tangents[:, 3:], axis=1) < MODE_RADIUS_RAD
    )
    weights = near / jnp.maximum(jnp.sum(near), 1)
    mean = jaxlie.SE3(best)
    for _ in range(MEAN_STEPS):
        tangents = jax.vmap(lambda pose, mean=mean: (mean.inverse() @ jaxlie.SE3(pose)).log())(poses)
        mean = mean @ jaxlie.SE3.exp(jnp.sum(weights[:, None] * tangents, axis=0))
    tangents = jax.vmap(lambda pose: (mean.inverse() @ jaxlie.SE3(pose)).log())(poses)
    return mean.wxyz_xyz, (weights[:, None] * tangents).T @ tangents


def _modes(poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Up to MODES poses (M, 4, 4) that the samples (S, 7) gather round, and their shares (M,)."""
    left = np.ones(len(poses), bool)
    matrices = np.asarray(jax.vmap(matrix_of)(jnp.asarray(poses)))
    centres, shares = np.tile(np.eye(4), (MODES, 1, 1)), np.zeros(MODES)
    for mode in range(MODES):
        if not left.any():
            break
        centre = matrices[np.flatnonzero(left)[-1]]
        near = _near(matrices, centre) & left
        centres[mode], shares[mode] = centre, near.mean()
        left &= ~near
    order = np.argsort(-shares, kind="stable")
    return centres[order], shares[order]


def _near(matrices: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.bool_]:
    distance = np.linalg.norm(matrices[:, :3, 3] - centre[:3, 3], axis=1)
    cosine = (np.einsum("nij,ij->n", matrices[:, :3, :3], centre[:3, :3]) - 1) / 2
    return (distance < MODE_RADIUS_M) & (cosine > np.cos(MODE_RADIUS_RAD))


def _edges(flat: Samples, model: SceneModel, count: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Probability (N, N + 1) of every edge, and its most frequent faces (N, N + 1, 2)."""
    parents = np.asarray(flat.parents)[:, :count]
    pairs = np.asarray(flat.child_faces)[:, :count] * 6 + np.asarray(flat.parent_faces)[:, :count]
    probabilities = np.zeros((count, count + 1))
    faces = np.full((count, count + 1, 2), -1, np.int32)
    for child in range(count):
        for parent in range(len(model.bodies.movable)):
            on = parents[:, child] == parent
            probabilities[child, parent] = on.mean()
            if on.any():
                faces[child, parent] = np.divmod(np.bincount(pairs[on, child]).argmax(), 6)
    return probabilities, faces


def _presence(
    model: SceneModel,
    start: Initialisation,
    world_from_camera: NDArray[np.float64],
    count: int,
    config: ParseConfig,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Probability of each object being there at its pose, and the share of it that is in sight.

    The likelihood ratio of the best scene with and without the object, times the prior odds; the object's
    other poses are left out.
    """
    likelihood = model.likelihood
    assert isinstance(likelihood, DepthImages)
    world = pose_of(jnp.asarray(world_from_camera))
    poses = jax.vmap(lambda pose: composed(world, pose))(jnp.asarray(start.poses))
    spare = len(model.bodies.movable) - count
    present = jnp.concatenate([jnp.asarray(start.found), jnp.ones(spare, bool)])
    scene = floating_scene(jnp.concatenate([poses, jnp.tile(poses[:1], (spare, 1))]), present)
    layers = likelihood.start(jax.random.key(0), scene).draws
    with_all = likelihood.log_density(layers, present)
    without = jnp.stack([likelihood.log_density(layers, present.at[one].set(False)) for one in range(count)])
    log_odds = logit(config.presence) + config.pixel_weight * np.asarray(with_all - without)
    first = np.asarray(layers[:, 0])
    rest = np.asarray(likelihood.rest_m[0])
    front = np.minimum(first.min(axis=0), rest)
    covers = np.isfinite(first)
    shown = covers & (first <= front[None])
    visible = shown.sum(axis=(1, 2)) / np.maximum(covers.sum(axis=(1, 2)), 1)
    return np.where(start.found, expit(log_odds), 0.0), visible
