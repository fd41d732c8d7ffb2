"""The generic step against filters that are known exactly: HMM, enumeration, Kalman, quadrature, ranks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from shapes.resampling import resample_systematically
from slam.filter import smc
from slam.filter.smc import Population, merged, thinned
from tests.slam.toy_models import AmbiguousWalk, Corridor, UnknownCorridor
from tests.statistical import assert_mean, assert_uniform

RUNS = 200
PLENTY = 10_000


def test_corridor_evidence_and_filter_are_those_of_the_forward_recursion(key, seed):
    """Z and Z E[f] are unbiased with six histories, and with light ones drawn; their means are the HMM's."""
    corridor = Corridor((0.0, 1.0, 0.2, 1.5, 0.4, 0.8))
    observations = np.random.default_rng(seed).normal(0.7, 0.6, 6)
    log_evidence, filtering = corridor.exact(observations)

    for most, least in ((6, 0.0), (PLENTY, 0.03)):
        keys = jax.random.split(jax.random.fold_in(key, most), RUNS)
        runs = [corridor.estimate(one, observations, most, least) for one in keys]
        ratio = np.exp([estimate - log_evidence for estimate, _ in runs])
        cells = np.stack([found for _, found in runs]) @ np.arange(6)
        assert_mean(ratio, 1.0, detectable=0.15)
        assert_mean(ratio * cells, filtering @ np.arange(6), detectable=0.3)


def test_unknown_map_evidence_and_filter_are_those_of_all_trajectories(key, seed):
    """Histories that own their maps are the sum over all S^T trajectories and all maps: nothing is drawn.

    Limit: rounding of double precision. With eight of them its mean is.
    """
    corridor = UnknownCorridor(cells=5)
    observations = np.random.default_rng(seed).integers(0, 2, 5)
    log_evidence, filtering = corridor.exact(observations)

    estimate, frequencies = corridor.estimate(jax.random.clone(key), observations, PLENTY)
    runs = [corridor.estimate(one, observations, 8) for one in jax.random.split(key, RUNS)]

    assert estimate == pytest.approx(log_evidence, abs=1e-9)
    np.testing.assert_allclose(frequencies, filtering, atol=1e-9)
    ratio = np.exp([one - log_evidence for one, _ in runs])
    assert_mean(ratio, 1.0, detectable=0.1)
    cells = np.stack([found for _, found in runs]) @ np.arange(5)
    assert_mean(ratio * cells, filtering @ np.arange(5), detectable=0.3)


def test_the_enumeration_sums_to_one_over_all_observations():
    """The oracle itself: evidences of all 2^T observation sequences add up to one."""
    corridor = UnknownCorridor(cells=3)
    total = sum(
        np.exp(corridor.exact(np.asarray([a, b, c]))[0]) for a in (0, 1) for b in (0, 1) for c in (0, 1)
    )

    assert total == pytest.approx(1.0, abs=1e-12)


def test_one_place_alone_is_kalman_s(key, seed):
    """Evidence, mean and variance to 1e-6; nothing is drawn."""
    walk = AmbiguousWalk()
    observations = np.random.default_rng(seed).normal(0.0, 1.5, 10)
    mean, variance, log_evidence = 0.0, 0.0, 0.0
    for observation in observations:
        mean, variance = walk.decay * mean, walk.decay**2 * variance + walk.step_variance
        spread = variance + walk.noise_variance
        log_evidence += stats.norm.logpdf(observation, mean, np.sqrt(spread))
        gain = variance / spread
        mean, variance = mean + gain * (observation - mean), (1 - gain) * variance

    estimate, population = walk.estimate(key, observations, 8)

    assert len(population) == 1
    assert estimate == pytest.approx(log_evidence, abs=1e-6)
    assert population.heaviest.mean == pytest.approx(mean, abs=1e-6)
    assert population.heaviest.variance == pytest.approx(variance, abs=1e-6)


def test_three_places_that_look_alike_are_the_mixture_of_quadrature(key, seed):
    """p(x_T) on a grid within 1e-6 where all are kept; its mean over runs where eight are."""
    walk = AmbiguousWalk(offsets=(-2.0, 0.0, 2.0))
    observations = np.random.default_rng(seed).normal(0.0, 1.5, 4)
    grid = np.linspace(-12, 12, 1201)
    log_evidence, density = walk.by_quadrature(observations, grid)

    def mixture(population: Population) -> np.ndarray:
        densities = [stats.norm.pdf(grid, one.mean, np.sqrt(one.variance)) for one in population.histories]
        return population.probabilities @ np.asarray(densities)

    estimate, population = walk.estimate(jax.random.clone(key), observations, PLENTY)
    runs = [walk.estimate(one, observations, 8) for one in jax.random.split(key, RUNS)]

    assert estimate == pytest.approx(log_evidence, abs=1e-6)
    np.testing.assert_allclose(mixture(population), density, atol=1e-6)
    assert max(len(found) for _, found in runs) <= 8
    ratio = np.exp([one - log_evidence for one, _ in runs])
    means = [
        share @ [one.mean for one in found.histories]
        for found in [f for _, f in runs]
        for share in [found.probabilities]
    ]
    assert_mean(ratio, 1.0, detectable=0.1)
    assert_mean(ratio * np.asarray(means), grid @ density * (grid[1] - grid[0]), detectable=0.15)


def test_ranks_of_the_truth_among_equal_draws_are_uniform(key, seed):
    """Simulation-based calibration with three places and two histories: drawn from the mixture, all equal."""
    walk, steps, trials, draws = AmbiguousWalk(offsets=(-2.0, 0.0, 2.0)), 4, 300, 199
    rng = np.random.default_rng(seed)
    ranks = []
    for trial_key in jax.random.split(key, trials):
        truth = 0.0
        observed = []
        for _ in range(steps):
            truth = walk.decay * truth + rng.normal(scale=np.sqrt(walk.step_variance))
            noise = rng.normal(scale=np.sqrt(walk.noise_variance))
            observed.append(truth + rng.choice(walk.offsets) + noise)
        _, population = walk.estimate(trial_key, np.asarray(observed), PLENTY)
        chosen = rng.choice(len(population), draws, p=population.probabilities)
        means, variances = (
            np.asarray([getattr(one, name) for one in population.histories]) for name in ("mean", "variance")
        )
        drawn = rng.normal(means[chosen], np.sqrt(variances[chosen]))
        ranks.append(((drawn < truth).sum() + rng.uniform()) / (draws + 1))

    assert_uniform(np.asarray(ranks))


@pytest.mark.parametrize(("most", "least"), [(5, 0.0), (40, 0.05)])
def test_thinning_changes_no_mean(key, most, least):
    """Of twelve weights, .21 to .02: each mean is what it was, heavy ones stay, at most so many are left."""
    weights = np.random.default_rng(0).permutation(0.8 ** np.arange(12))
    weights /= weights.sum()
    log_weights = np.log(weights)
    after = np.zeros((2000, 12))
    for run, one in enumerate(jax.random.split(key, len(after))):
        kept, left = thinned(one, log_weights, most, least)
        after[run, kept] = np.exp(left)
        assert len(kept) <= most + 1e-9

    varying = np.ptp(after, axis=0) > 0
    np.testing.assert_allclose(after[:, ~varying], np.tile(weights[~varying], (len(after), 1)))
    assert varying.any()
    assert (weights[~varying] >= weights[varying].max()).all()
    assert_mean(after[:, varying], weights[varying], detectable=0.05)


def test_few_histories_are_left_as_they_are(key):
    """Nothing is drawn, and the weights are exact."""
    log_weights = np.log([0.5, 0.3, 0.2])

    kept, after = thinned(key, log_weights, 8, 0.01)

    np.testing.assert_array_equal(kept, [0, 1, 2])
    np.testing.assert_array_equal(after, log_weights)


def test_of_alike_histories_one_goes_on_with_the_weight_of_all(key):
    """As often each as it is heavy."""
    population = Population(("a", "B", "A", "c"), np.log([0.1, 0.4, 0.3, 0.2]))

    runs = [
        merged(one, population, lambda first, second: first.lower() == second.lower())
        for one in jax.random.split(key, 1000)
    ]

    for found, kept in runs:
        assert [one.lower() for one in found.histories] == ["a", "b", "c"]
        assert [population.histories[index] for index in kept] == list(found.histories)
        np.testing.assert_allclose(np.exp(found.log_weights), [0.4, 0.4, 0.2])
    assert_mean(np.asarray([found.histories[0] == "A" for found, _ in runs]), 0.75, detectable=0.1)


def test_info_says_what_the_step_did(key):
    """Ancestors in the population before, evidence of all branches, those that have none gone."""
    population = Population((0, 1), np.log([0.25, 0.75]))

    stepped, info = smc.step(
        key, population, lambda index, one: [(one + 10, -2.0), (one + 20, -2.0)] * index, 8, 0.0
    )

    assert stepped.histories == (11, 21)
    np.testing.assert_array_equal(info.ancestors, [1, 1])
    np.testing.assert_allclose(stepped.log_weights, np.log([0.5, 0.5]))
    assert info.log_evidence == pytest.approx(np.log(2 * 0.75) - 2.0)
    assert not info.resampled


def test_systematic_draws_every_particle_floor_or_ceil_of_its_share(key):
    """Offspring counts differ from K w by less than one, and by nothing in the mean."""
    log_weights = jax.nn.log_softmax(jax.random.normal(jax.random.fold_in(key, 0), (40,)) * 2)
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
