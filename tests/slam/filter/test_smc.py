"""The generic step against filters that are known exactly: HMM, enumeration, Kalman, weighted-rank SBC."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from shapes.resampling import resample_systematically
from slam.filter import smc
from slam.filter.smc import effective_sample_size, normalise
from tests.slam.toy_models import Corridor, RandomWalk, UnknownCorridor
from tests.statistical import assert_mean, assert_uniform

RUNS = 1000


def test_corridor_evidence_and_filter_are_those_of_the_forward_recursion(key, seed):
    """Z and Z E[f] are unbiased: their means over runs are the HMM's (log Z itself is biased)."""
    corridor = Corridor((0.0, 1.0, 0.2, 1.5, 0.4, 0.8))
    observations = np.random.default_rng(seed).normal(0.7, 0.6, 8)
    log_evidence, filtering = corridor.exact(observations)

    run = jax.jit(jax.vmap(lambda run_key: corridor.estimate(run_key, observations, 64)))
    estimates, frequencies = run(jax.random.split(key, RUNS))

    ratio = np.exp(np.asarray(estimates, np.float64) - log_evidence)
    assert_mean(ratio, 1.0, detectable=0.06)
    assert_mean(ratio[:, None] * np.asarray(frequencies), filtering, detectable=0.06)


def test_unknown_map_evidence_and_filter_are_those_of_all_trajectories(key, seed):
    """Particles that own their maps agree with summing all S^T trajectories and all maps."""
    corridor = UnknownCorridor(cells=5)
    observations = np.random.default_rng(seed).integers(0, 2, 5)
    log_evidence, filtering = corridor.exact(observations)

    run = jax.jit(jax.vmap(lambda run_key: corridor.estimate(run_key, observations, 64)))
    estimates, frequencies = run(jax.random.split(key, RUNS))

    ratio = np.exp(np.asarray(estimates, np.float64) - log_evidence)
    assert_mean(ratio, 1.0, detectable=0.03)
    assert_mean(ratio[:, None] * np.asarray(frequencies), filtering, detectable=0.03)


def test_the_enumeration_sums_to_one_over_all_observations():
    """The oracle itself: evidences of all 2^T observation sequences add up to one."""
    corridor = UnknownCorridor(cells=3)
    total = sum(
        np.exp(corridor.exact(np.asarray([a, b, c]))[0]) for a in (0, 1) for b in (0, 1) for c in (0, 1)
    )

    assert total == pytest.approx(1.0, abs=1e-12)


def test_random_walk_evidence_and_mean_are_kalman_s(key, seed):
    """Evidence and posterior moments of a linear-Gaussian model are the Kalman filter's."""
    walk = RandomWalk()
    observations = np.random.default_rng(seed).normal(0.0, 1.5, 10)
    log_evidence, mean, variance = walk.exact(observations)

    run = jax.jit(
        jax.vmap(lambda run_key: walk.estimate(run_key, jnp.asarray(observations, jnp.float32), 256))
    )
    estimates, particles, log_weights = run(jax.random.split(key, RUNS))

    ratio = np.exp(np.asarray(estimates, np.float64) - log_evidence)
    weights = np.exp(np.asarray(log_weights, np.float64))
    first = (weights * np.asarray(particles)).sum(1)
    second = (weights * (np.asarray(particles) - mean) ** 2).sum(1)
    assert_mean(ratio, 1.0, detectable=0.1)
    assert_mean(ratio * first, mean, detectable=0.1)
    assert_mean(ratio * second, variance, detectable=0.1)


def test_weighted_ranks_of_the_truth_are_uniform(key):
    """Simulation-based calibration: with truths from the prior, sum of weights below the truth is uniform."""
    walk, steps, trials = RandomWalk(), 5, 400

    def rank(trial_key: jax.Array) -> jax.Array:
        walk_key, noise_key, filter_key = jax.random.split(trial_key, 3)
        noise = jax.random.normal(walk_key, (steps,)) * walk.step_variance**0.5
        states = [noise[0]]
        for step in range(1, steps):
            states.append(walk.decay * states[-1] + noise[step])
        truth = jnp.stack(states)
        observed = truth + jax.random.normal(noise_key, (steps,)) * walk.noise_variance**0.5
        _, particles, log_weights = walk.estimate(filter_key, observed, 1000)
        return (jnp.exp(log_weights) * (particles < truth[-1])).sum()

    ranks = jax.jit(jax.vmap(rank))(jax.random.split(key, trials))

    assert_uniform(np.asarray(ranks))


def test_systematic_draws_every_particle_floor_or_ceil_of_its_share(key):
    """Offspring counts differ from K w by less than one, and by nothing in the mean."""
    log_weights, _ = normalise(jax.random.normal(jax.random.fold_in(key, 0), (40,)) * 2)
    expected = 40 * np.exp(np.asarray(log_weights, np.float64))
    keys = jax.random.split(jax.random.fold_in(key, 1), 4000)

    ancestors = jax.vmap(resample_systematically, (0, None))(keys, log_weights)
    counts = np.asarray(jax.vmap(lambda drawn: jnp.bincount(drawn, length=40))(ancestors))

    assert (np.abs(counts - expected) < 1 + 1e-4).all()
    varying = counts.std(axis=0) > 0
    assert_mean(counts[:, varying], expected[varying], detectable=0.05)


def test_systematic_never_draws_a_particle_without_weight(key):
    """Weights of zero at either end, and a cumulative sum that rounds below one, draw no dead particle."""
    log_weights = jnp.full(1001, -jnp.inf).at[300:700].set(-jnp.log(400.0))

    ancestors = np.asarray(
        jax.vmap(resample_systematically, (0, None))(jax.random.split(key, 100), log_weights)
    )

    assert ancestors.min() >= 300
    assert ancestors.max() < 700


def test_effective_sample_size_of_equal_and_of_one_hot_weights():
    """K for equal weights, one where a single particle has everything."""
    equal, _ = normalise(jnp.zeros(50))
    one_hot, _ = normalise(jnp.full(50, -jnp.inf).at[3].set(0.0))

    assert float(effective_sample_size(equal)) == pytest.approx(50, rel=1e-5)
    assert float(effective_sample_size(one_hot)) == pytest.approx(1, rel=1e-5)


def test_weights_that_all_vanish_become_uniform():
    """A frame that no particle can explain keeps the population usable and reports no evidence."""
    log_weights, log_sum = normalise(jnp.full(8, -jnp.inf))

    np.testing.assert_allclose(np.exp(log_weights), 1 / 8, rtol=1e-6)
    assert log_sum == -jnp.inf


def test_info_says_what_the_step_did(key):
    """Ancestors and `resampled` describe the drawing before the proposal, evidence the weighting after."""
    population = smc.Population(jnp.arange(4.0), normalise(jnp.asarray([0.0, -50.0, -50.0, -50.0]))[0])

    stepped, info = smc.step(key, population, lambda _, x: (x, jnp.full(4, -2.0)), 0.5)

    assert bool(info.resampled)
    np.testing.assert_array_equal(info.ancestors, 0)
    np.testing.assert_array_equal(stepped.particles, 0.0)
    assert float(info.log_evidence) == pytest.approx(-2.0, abs=1e-5)
    assert float(info.ess) == pytest.approx(4.0, rel=1e-5)
