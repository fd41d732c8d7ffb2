"""Parsed scenes without a chain."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from scene.result import SceneResult


def scene_result(names: Sequence[str], poses: ArrayLike, parents: Sequence[int]) -> SceneResult:
    """Objects at certain poses (N, 4, 4) on certain parents; N is the table."""
    count = len(names)
    placed = np.asarray(poses, np.float64)
    edges = np.zeros((count, count + 1))
    edges[np.arange(count), parents] = 1
    return SceneResult(
        names=np.array(names),
        frames=np.array([0]),
        camera_from_object=placed,
        most_probable=placed,
        covariance=np.tile(np.eye(6), (count, 1, 1)),
        presence=np.ones(count),
        presence_std=np.zeros(count),
        hidden_presence=np.zeros(count),
        number_probabilities=np.tile(np.arange(count + 1) == 1, (count, 1)).astype(np.float64),
        hidden_share=np.zeros(count),
        hidden_poses=np.tile([1.0, 0, 0, 0, 0, 0, 0], (count, 1, 1)),
        visible_fraction=np.ones(count),
        colour_nats=np.zeros(count),
        mode_poses=placed[:, None],
        mode_probabilities=np.ones((count, 1)),
        sample_modes=np.zeros((1, count), np.int32),
        edge_probabilities=edges,
        edge_faces=np.full((count, count + 1, 2), -1, np.int32),
        sample_poses=np.zeros((1, count, 7)),
        sample_parents=np.asarray([parents], np.int32),
        sample_log_posteriors=np.zeros(1),
        chain=np.zeros(1, np.int32),
        acceptance=np.array(0.5),
        log_estimate_variance=np.array(0.0),
    )
