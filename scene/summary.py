"""What samples of a scene say: means, covariances, modes, edges, presence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from scene.config import ParseConfig
from scene.initialisation import Initialisation
from scene.model import SceneModel
from scene.poses import motions_of, tangents_of
from scene.refinement import Refinement
from scene.result import SceneResult
from scene.scene_object import SceneObject
from shapes.poses import matrices_of, poses_of

MODES = 4
MODE_RADIUS_M, MODE_RADIUS_RAD = 0.02, 0.5
MEAN_STEPS = 5


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Samples:
    """Kept states of chains: (S, chains, ...) of whole runs, any leading axes before.

    Attributes:
        poses: (..., C, 7) world_from_box.
        parents: (..., C).
        parent_faces: (..., C).
        child_faces: (..., C).
        log_posterior: (...).
        accepted: (...) share of the moves of poses before it that were accepted.
    """

    poses: jax.Array
    parents: jax.Array
    parent_faces: jax.Array
    child_faces: jax.Array
    log_posterior: jax.Array
    accepted: jax.Array

    @classmethod
    def joined(cls, blocks: Sequence[Samples]) -> Samples:
        """Blocks (count, chains, ...) after one another."""
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *blocks)


def summarise(
    samples: Samples,
    model: SceneModel,
    start: Initialisation,
    refined: Refinement,
    world_from_camera: NDArray[np.float64],
    objects: Sequence[SceneObject],
    frames: NDArray[np.int64],
    config: ParseConfig,
    log_estimate_variance: float,
) -> SceneResult:
    """The result in the first camera and in the objects' own frames."""
    count = len(objects)
    kept, chains = samples.log_posterior.shape
    flat = jax.tree.map(lambda leaf: leaf.reshape(kept * chains, *leaf.shape[2:]), samples)
    box_from_object = matrices_of(np.stack([[1.0, 0, 0, 0, *(-one.centre_m)] for one in objects]))
    in_world = matrices_of(np.asarray(flat.poses[:, :count]))
    poses = np.linalg.inv(world_from_camera) @ in_world @ box_from_object
    best = matrices_of(start.poses) @ box_from_object
    moments = [_moments(poses[:, one], best[one]) for one in range(count)]
    modes = [_modes(poses[:, one]) for one in range(count)]
    edges, faces = _edges(flat, model, count)
    return SceneResult(
        names=np.array([one.name for one in objects]),
        frames=np.asarray(frames, np.int64),
        camera_from_object=best,
        mean=np.stack([mean for mean, _ in moments]),
        covariance=np.stack([covariance for _, covariance in moments]),
        presence=expit(config.pixel_weight * start.log_odds),
        visible_fraction=refined.visible_fraction,
        mode_poses=np.stack([poses for poses, _ in modes]),
        mode_probabilities=np.stack([shares for _, shares in modes]),
        edge_probabilities=edges,
        edge_faces=faces,
        sample_poses=poses_of(poses),
        sample_parents=np.asarray(flat.parents[:, :count], np.int32),
        sample_log_posteriors=np.asarray(flat.log_posterior),
        chain=np.tile(np.arange(chains, dtype=np.int32), kept),
        acceptance=np.asarray(np.mean(flat.accepted)),
        log_estimate_variance=np.asarray(log_estimate_variance),
    )


def _moments(
    poses: NDArray[np.float64], best: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean (4, 4) and right covariance (6, 6) of the samples (S, 4, 4) in the mode of `best`."""
    tangents = tangents_of(np.linalg.inv(best) @ poses)
    near = (np.linalg.norm(tangents[:, :3], axis=1) < MODE_RADIUS_M) & (
        np.linalg.norm(tangents[:, 3:], axis=1) < MODE_RADIUS_RAD
    )
    weights = near / max(near.sum(), 1)
    mean = best
    for _ in range(MEAN_STEPS):
        mean = mean @ motions_of(weights @ tangents_of(np.linalg.inv(mean) @ poses))
    tangents = tangents_of(np.linalg.inv(mean) @ poses)
    return mean, (weights[:, None] * tangents).T @ tangents


def _modes(matrices: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Up to MODES poses (M, 4, 4) that the samples (S, 4, 4) gather round, and their shares (M,)."""
    left = np.ones(len(matrices), bool)
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
