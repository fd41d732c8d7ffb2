"""Summary of the samples: means, covariances, modes, edge probabilities, presence."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from scene.config import ParseConfig
from scene.mcmc.samples import Samples
from scene.model.presence import log_odds_of_presence
from scene.model.scene_graph import ROOT
from scene.objects.scene_object import SceneObject
from scene.objects.slots import FoundObjects
from scene.result import SceneResult
from scene.search.search_result import Initialisation
from shapes.geometry.poses import matrices_of, motions_of, poses_of, tangents_of

MODES = 4

MODE_RADIUS_M, MODE_RADIUS_RAD = 0.02, 0.5

MEAN_STEPS = 5


def summarise(
    samples: Samples,
    chosen: FoundObjects,
    start: Initialisation,
    visible_fraction: NDArray[np.float64],
    unseen: NDArray[np.float64],
    world_from_camera: NDArray[np.float64],
    objects: Sequence[SceneObject],
    frames: NDArray[np.int64],
    config: ParseConfig,
    log_estimate_variance: float,
) -> SceneResult:
    """The result in the first camera and in the objects' own frames; what was not found stands still.

    Args:
        samples: of the chosen objects.
        chosen: which of all these are.
        start: the best scene of all objects.
        visible_fraction: (N,).
        unseen: (N,) share of the prior's poses that no view shows.
        world_from_camera: (4, 4).
        objects: all N.
        frames: numbers of the frames used.
        config: settings.
        log_estimate_variance: of the log likelihood's estimate.
    """
    count = len(objects)
    kept, chains = samples.log_posterior.shape
    flat = jax.tree.map(lambda leaf: leaf.reshape(kept * chains, *leaf.shape[2:]), samples)
    flat = _of_all(flat, chosen)
    box_from_object = matrices_of(np.stack([[1.0, 0, 0, 0, *(-one.centre_m)] for one in objects]))
    starts, in_world = matrices_of(start.poses), matrices_of(flat.poses)
    in_camera = np.where(
        start.found[:, None, None], np.linalg.inv(world_from_camera) @ in_world, starts[None]
    )
    poses = in_camera @ box_from_object
    modes = [_modes(poses[:, one]) for one in range(count)]
    moments = [_moments(poses[:, one], modes[one][0][0]) for one in range(count)]
    edges, faces = _edges(flat, count, max(samples.parents.shape[-1] - chosen.slots, 1))
    return SceneResult(
        names=np.array([one.name for one in objects]),
        frames=np.asarray(frames, np.int64),
        camera_from_object=np.stack([mean for mean, _ in moments]),
        covariance=np.stack([covariance for _, covariance in moments]),
        most_probable=poses[int(flat.log_posterior.argmax())],
        presence=expit(log_odds_of_presence(start.log_odds, unseen, config.presence)),
        visible_fraction=visible_fraction,
        mode_poses=np.stack([poses for poses, _ in modes]),
        mode_probabilities=np.stack([shares for _, shares in modes]),
        edge_probabilities=edges,
        edge_faces=faces,
        sample_poses=poses_of(poses),
        sample_parents=flat.parents,
        sample_log_posteriors=flat.log_posterior,
        chain=np.tile(np.arange(chains, dtype=np.int32), kept),
        acceptance=np.asarray(np.mean(flat.accepted), np.float64),
        log_estimate_variance=np.asarray(log_estimate_variance),
    )


def _of_all(flat: Samples, chosen: FoundObjects) -> Samples:
    """Samples (S, ...) of slots as those of all objects; what was not found floats nowhere."""
    kept = len(flat.log_posterior)
    parents = chosen.parents(flat.parents)
    nowhere = np.tile([1.0, 0, 0, 0, 0, 0, 0], (kept, chosen.count, 1))
    none = np.zeros((kept, chosen.count), np.int32)
    return Samples(
        chosen.spread(flat.poses, nowhere),
        chosen.spread(parents, none + ROOT),
        chosen.spread(flat.parent_faces, none),
        chosen.spread(flat.child_faces, none),
        flat.log_posterior,
        flat.accepted,
    )


def _moments(
    poses: NDArray[np.float64], centre: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean (4, 4) and right covariance (6, 6) of the samples (S, 4, 4) in the mode round one of them."""
    near = _near(poses, centre)
    weights = near / near.sum()
    mean = centre
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


def _edges(flat: Samples, count: int, supports: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Probability (N, N + S) of every edge, and its most frequent faces (N, N + S, 2)."""
    pairs = flat.child_faces * 6 + flat.parent_faces
    probabilities = np.zeros((count, count + supports))
    faces = np.full((count, count + supports, 2), -1, np.int32)
    for child in range(count):
        for parent in np.unique(flat.parents[:, child][flat.parents[:, child] != ROOT]):
            on = flat.parents[:, child] == parent
            probabilities[child, parent] = on.mean()
            faces[child, parent] = np.divmod(np.bincount(pairs[on, child]).argmax(), 6)
    return probabilities, faces
