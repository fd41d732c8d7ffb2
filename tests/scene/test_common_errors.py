"""Errors that all pixels of an object share: their moments, and what they leave alone."""

import numpy as np
from scipy.spatial.transform import Rotation

from scene.common_errors import with_common_errors

SCALE_ERROR, ERROR_M, SAMPLES = 0.01, 0.002, 4000


def test_samples_hold_the_errors_of_scale_and_of_surfaces(seed: int) -> None:
    """Two boxes at 1 and 2 m: places err along the ray in common, aside and in turns alone.

    Variances of 4,000 draws within 6 standard errors (relative error sqrt(2 / 4,000), 2%), correlations
    within 6 / sqrt(4,000): a false alarm in 1e-7 of all runs.
    """
    rng = np.random.default_rng(seed)
    boxes = np.tile(np.eye(4), (SAMPLES, 2, 1, 1))
    boxes[..., :3, :3] = Rotation.random(2, rng=rng).as_matrix()
    boxes[..., 2, 3] = 1.0, 2.0
    there = with_common_errors(rng, boxes, np.array([0.05, 0.1]), SCALE_ERROR, ERROR_M)

    off = there[..., :3, 3] - boxes[..., :3, 3]
    along = np.array([SCALE_ERROR, 2 * SCALE_ERROR]) ** 2 + ERROR_M**2
    expected = np.stack([np.full(2, ERROR_M**2), np.full(2, ERROR_M**2), along], axis=1)
    np.testing.assert_allclose(off.var(axis=0), expected, rtol=6 * np.sqrt(2 / SAMPLES))
    common = np.corrcoef(off[:, 0, 2], off[:, 1, 2])[0, 1]
    np.testing.assert_allclose(common, 2 * SCALE_ERROR**2 / np.sqrt(along.prod()), atol=6 / np.sqrt(SAMPLES))
    assert abs(np.corrcoef(off[:, 0, 0], off[:, 1, 0])[0, 1]) < 6 / np.sqrt(SAMPLES)
    turned = np.swapaxes(boxes[..., :3, :3], -1, -2) @ there[..., :3, :3]
    turns = Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_rotvec().reshape(SAMPLES, 2, 3)
    expected = np.tile((ERROR_M / np.array([0.05, 0.1]))[:, None] ** 2, 3)
    np.testing.assert_allclose(turns.var(axis=0), expected, rtol=6 * np.sqrt(2 / SAMPLES))


def test_without_errors_samples_stay(seed: int) -> None:
    """Bit by bit but for rounding."""
    boxes = np.tile(np.eye(4), (3, 2, 1, 1))
    boxes[..., :3, 3] = np.random.default_rng(seed).normal(size=(3, 2, 3))
    same = with_common_errors(np.random.default_rng(seed), boxes, np.ones(2), 0.0, 0.0)
    np.testing.assert_allclose(same, boxes, atol=1e-12)
