"""Diagnostics of chains on chains whose answer is known."""

import numpy as np
import pytest

from scene.convergence import effective_samples, split_r_hat


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
