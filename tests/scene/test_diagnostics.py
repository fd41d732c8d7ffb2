"""What is said of chains whose answer is known, and of which of their traces."""

from dataclasses import replace

import numpy as np
import pytest

from scene.diagnostics import convergence, scene_convergence
from tests.scene.results import scene_result


def autoregression(rng: np.random.Generator, count: int, chains: int, memory: float) -> np.ndarray:
    """Stationary AR(1) draws (1, chains, count) of variance 1."""
    draws = rng.normal(size=(count, chains))
    for step in range(1, count):
        draws[step] = memory * draws[step - 1] + np.sqrt(1 - memory**2) * draws[step]
    return draws.T[None]


@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_effective_samples_of_an_autoregression(seed: int, memory: float) -> None:
    """It is n (1 - a) / (1 + a), within 15% over 80,000 draws (4 standard errors at a = 0.8)."""
    draws = autoregression(np.random.default_rng(seed), 20_000, 4, memory)
    exact = draws.size * (1 - memory) / (1 + memory)
    found = convergence(draws)
    assert found.bulk_samples == pytest.approx(exact, rel=0.15)
    assert found.r_hat < 1.01
    assert found.converged


def test_chains_that_disagree_are_told(seed: int) -> None:
    """One chain of four is shifted by three standard deviations; then a drift within every chain."""
    draws = np.random.default_rng(seed).normal(size=(1, 4, 500))
    shift = np.array([0.0, 0.0, 0.0, 3.0])[:, None]
    assert convergence(draws + shift).r_hat > 1.3
    assert convergence(draws + np.linspace(0, 4, 500)).r_hat > 1.2
    assert convergence(draws + shift).effective_samples < 20
    assert not convergence(draws + shift).converged


def test_the_worst_trace_counts(seed: int) -> None:
    """Of a good one, one that never changes, and one whose chains each stand still."""
    good = np.random.default_rng(seed).normal(size=(4, 500))
    still, stuck = np.ones((4, 500)), np.repeat([[0.0], [0.0], [0.0], [1.0]], 500, axis=1)
    assert convergence(np.stack([good, still])).r_hat < 1.02
    assert convergence(np.stack([good, still, stuck])).r_hat == np.inf
    assert convergence(still[None]).effective_samples == still.size
    assert np.isnan(convergence(good[None, :, :3]).r_hat)
    assert not convergence(good[None, :, :3]).converged


def test_half_a_turn_moves_no_centre(seed: int) -> None:
    """Chains that keep to two poses which look the same agree on the box's middle, not on the mode."""
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
        sample_modes=np.tile(np.array([0, 0, 1, 1], np.int32), 200)[:, None],
        mode_probabilities=np.array([[0.5, 0.5]]),
        chain=np.tile(np.arange(4, dtype=np.int32), 200),
    )

    told = scene_convergence(scene, middle[None])
    assert told.overall.r_hat < 1.03
    assert told.centres[0].converged
    assert not told.modes[0].converged
    assert scene_convergence(scene, np.zeros((1, 3))).overall.r_hat > 1.5


def test_a_trace_of_two_values_by_halves_has_an_r_hat() -> None:
    """Folded about its median it is one value, which no variance can be divided by."""
    trace = np.tile([0.0, 1.0], (1, 4, 20))
    assert convergence(trace).r_hat == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("chains", [1, 2])
def test_a_trace_that_changes_for_one_draw_has_an_r_hat(chains: int) -> None:
    """Wherever that is, and whether or not the number of draws is even; it is the worst in any order."""
    for draws in (8, 15, 67):
        for place in range(draws):
            trace = np.zeros((chains, draws))
            trace[0, place] = 1.0
            other = np.array([[float(draw % 4 > 1) for draw in range(draws)]] * chains)
            found = [convergence(np.stack(two)).r_hat for two in ((trace, other), (other, trace))]
            assert not np.isnan(found).any()
            assert found[0] == found[1]
