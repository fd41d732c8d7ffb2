import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise
from tests.statistical import assert_frequencies

NOISES = [
    DepthNoise(),
    DepthNoise(outlier_probability=0.1, none_hit_probability=0.3, none_miss_probability=0.6),
    DepthNoise(
        sigma_base_m=0.02,
        sigma_growth_per_m=0.0,
        outlier_probability=0.1,
        none_hit_probability=0.0,
        none_miss_probability=0.0,
        max_range_m=5.0,
    ),
]


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("surface_m", [0.3, 0.9, 4.0, 5.0, np.inf])
def test_density_integrates_to_one(noise: DepthNoise, surface_m: float) -> None:
    """The Lebesgue part over the whole line plus the atom is one, also at the end of the range."""
    with jax.enable_x64(True):
        far = noise.max_range_m + 1.0
        step = 1e-5
        depths = jnp.arange(-1.0, far, step) + step / 2
        rendered = jnp.full_like(depths, surface_m)
        lebesgue = jnp.exp(depth_noise.log_density(noise, depths, rendered)).sum() * step
        atom = jnp.exp(depth_noise.log_density(noise, jnp.array(NO_RETURN), rendered[0]))

    np.testing.assert_allclose(lebesgue + atom, 1.0, atol=5e-6)  # one step of the uniform's edges


@pytest.mark.parametrize("noise", NOISES[:2])
@pytest.mark.parametrize("surface_m", [0.9, np.inf])
def test_density_agrees_with_its_sampler(key: jax.Array, noise: DepthNoise, surface_m: float) -> None:
    """Draws fall into the cells of the line, and on the atom, as often as the density says."""
    draws = np.asarray(depth_noise.sample(key, noise, jnp.full((200_000,), surface_m)))
    none_probability = noise.none_hit_probability if np.isfinite(surface_m) else noise.none_miss_probability
    edges = np.array([-1.0, 0.3, 0.898, 0.9, 0.902, 4.0, 11.0])
    cumulative = np.clip(edges, 0, noise.max_range_m) / noise.max_range_m
    if np.isfinite(surface_m):
        sigma = float(depth_noise.standard_deviation(noise, jnp.array(surface_m)))
        share = noise.outlier_probability
        cumulative = share * cumulative + (1 - share) * stats.norm(surface_m, sigma).cdf(edges)
    else:
        edges, cumulative = edges[[0, 1, 5, 6]], cumulative[[0, 1, 5, 6]]
    probabilities = [none_probability, *((1 - none_probability) * np.diff(cumulative))]
    returns = draws[draws != NO_RETURN]

    counts = [(draws == NO_RETURN).sum(), *np.histogram(returns, edges)[0]]

    assert_frequencies(counts, np.array(probabilities) / np.sum(probabilities))


def test_density_is_the_written_mixture() -> None:
    """Hand-computed value: the atom's complement times outlier plus Normal."""
    noise = DepthNoise(outlier_probability=0.1, none_hit_probability=0.2)
    sigma = 0.0012 + 0.0019 * 0.6**2
    expected = np.log(0.8 * (0.1 / 10.0 + 0.9 * stats.norm.pdf(1.001, 1.0, sigma)))

    with jax.enable_x64(True):
        actual = depth_noise.log_density(noise, jnp.array(1.001), jnp.array(1.0))

    np.testing.assert_allclose(actual, expected, rtol=1e-12)
