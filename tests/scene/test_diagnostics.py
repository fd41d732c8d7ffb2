"""Diagnostics of chains on chains whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from scene.diagnostics import convergence, effective_samples, split_r_hat
from tests.scene.results import scene_result


def autoregression(rng: np.random.Generator, count: int, chains: int, memory: float) -> np.ndarray:
    """Stationary AR(1) draws (count, chains) of variance 1."""
    draws = rng.normal(size=(count, chains))
    for step in range(1, count):
        draws[step] = memory * draws[step - 1] + np.sqrt(1 - memory**2) * draws[step]
    return draws


@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_effective_samples_of_an_autoregression(seed: int, memory: float) -> None:
    """It is n (1 - a) / (1 + a), within 15% over 80,000 draws (4 standard errors at a = 0.8)."""
    draws = autoregression(np.random.default_rng(seed), 20_000, 4, memory)
    exact = draws.size * (1 - memory) / (1 + memory)
    assert effective_samples(draws) == pytest.approx(exact, rel=0.15)
    assert split_r_hat(draws) < 1.01


def test_chains_that_disagree_are_told(seed: int) -> None:
    """One chain of four is shifted by three standard deviations; then a drift within every chain."""
    draws = np.random.default_rng(seed).normal(size=(500, 4))
    shift = np.array([0.0, 0.0, 0.0, 3.0])
    assert split_r_hat(draws + shift) > 1.5
    assert split_r_hat(draws + np.linspace(0, 4, 500)[:, None]) > 1.3
    assert effective_samples(draws + shift) < 20


def test_half_a_turn_moves_no_centre(seed: int) -> None:
    """Chains that keep to two poses which look the same agree on the box's middle, not on the origin."""
    rng = np.random.default_rng(seed)
    middle = np.array([0.03, 0.05, 0.02])
    half_turns = np.array([[1.0, 0, 0, 0], [0.0, 0, 0, 1]])[np.array([0, 0, 1, 1])]
    turned = middle * np.where(np.arange(4)[:, None] < 2, 1.0, [-1.0, -1.0, 1.0])
    offsets = 0.001 * rng.normal(size=(200, 4, 3))
    poses = np.concatenate([np.broadcast_to(half_turns, (200, 4, 4)), offsets - turned], axis=2)
    scene = replace(
        scene_result(["box"], np.eye(4)[None], [1]),
        sample_poses=poses.reshape(800, 1, 7),
        sample_parents=np.ones((800, 1), np.int32),
        sample_log_posteriors=np.zeros(800),
        chain=np.tile(np.arange(4, dtype=np.int32), 200),
    )

    assert convergence(scene, middle[None]).r_hat < 1.03
    assert convergence(scene, np.zeros((1, 3))).r_hat > 10
