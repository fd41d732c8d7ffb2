"""The colour density integrates to one, agrees with its sampler, and albedos are integrated out exactly."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from scipy.special import logsumexp

from scene.colour.density import (
    ColourNoise,
    Segments,
    albedo_evidence,
    fit,
    laplace_evidence,
    log_density,
    sample,
)
from tests.statistical import FALSE_ALARM

UNKNOWN = np.zeros(1, np.bool_)
"""Of one object, whose colours nobody knows."""


@pytest.mark.parametrize("sigma", [0.01, 0.05, 0.3])
@pytest.mark.parametrize("outlier", [0.001, 0.05, 0.5])
@pytest.mark.parametrize("rendered", [-0.2, 0.0, 0.4, 1.3])
@pytest.mark.parametrize("wider", [None, 0.1, 0.25])
def test_the_density_of_a_channel_integrates_to_one(
    sigma: float, outlier: float, rendered: float, wider: float | None
) -> None:
    """Over the whole line: what is darker than 0 or brighter than 1 is not clipped; at outlines too."""
    noise, sd = ColourNoise(sigma=sigma, outlier=outlier), None if wider is None else np.hypot(sigma, wider)
    edges = np.concatenate([np.linspace(-4, 0, 40001), np.linspace(0, 1, 20001), np.linspace(1, 4, 30001)])
    middle, width = (edges[1:] + edges[:-1]) / 2, np.diff(edges)

    assert np.exp(log_density(middle, np.array(rendered), noise, sd)) @ width == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("rendered", [-0.1, 0.5, 0.97, 1.2])
def test_what_was_clipped_counts_for_all_beyond(rendered: float) -> None:
    """Inside, and both ends, have the mass 1, but for an outlier's 2 of 256 stored values."""
    noise = ColourNoise(sigma=0.05, outlier=0.1)
    edges = np.linspace(0, 1, 20001)
    inside = np.exp(log_density((edges[1:] + edges[:-1]) / 2, np.array(rendered), noise)).mean()
    ends = np.exp(log_density(np.array([np.inf, -np.inf]), np.array(rendered), noise)).sum()
    assert inside + ends == pytest.approx(1 + 0.1 * 2 / 256, abs=1e-6)


def whole(
    start: NDArray[np.int64],
    colour: NDArray[np.floating],
    lit: NDArray[np.floating],
    is_known: NDArray[np.bool_],
) -> Segments:
    """Objects that fill all of their pixels."""
    share, base = np.ones((len(colour), 1)), np.zeros(colour.shape)
    return Segments(start, colour, lit, is_known, share, base, None, None)


def test_clipped_pixels_bound_the_albedo(seed: int) -> None:
    """Evidence with pixels over 1 is that of the sum over 20,000 albedos."""
    noise = ColourNoise()
    rng = np.random.default_rng(seed)
    shade = rng.uniform(0.6, 1.0, 40)
    colour = 1.1 * shade[:, None] + noise.sigma * rng.standard_normal((40, 1))
    segments = whole(np.array([0, 40]), np.where(colour > 1, np.inf, colour), shade[:, None], UNKNOWN)
    grid = np.linspace(noise.albedo_mean - 2.4, noise.albedo_mean + 2.4, 20_001)
    logs = log_density(segments.colour, shade[:, None] * grid, noise).sum(axis=0)
    logs += stats.norm.logpdf(grid, noise.albedo_mean, noise.albedo_sd)
    expected = np.logaddexp.reduce(logs) + np.log(grid[1] - grid[0])
    assert np.isinf(segments.colour).any()
    assert albedo_evidence(segments, noise)[0] == pytest.approx(expected, abs=1e-6)


def test_the_sampler_draws_from_the_density(seed: int) -> None:
    """Kolmogorov-Smirnov against the cumulated density; false alarm 1e-6."""
    noise = ColourNoise(sigma=0.05, outlier=0.3)
    drawn = sample(np.random.default_rng(seed), np.full(20_000, 0.9), noise)

    def cumulated(value: np.ndarray) -> np.ndarray:
        normal = stats.norm(0.9, noise.sigma).cdf(value)
        return (1 - noise.outlier) * normal + noise.outlier * np.clip(value, 0, 1)

    assert stats.kstest(drawn, cumulated).pvalue > FALSE_ALARM


def pixels(rng: np.random.Generator, counts: list[int], noise: ColourNoise) -> Segments:
    """Objects of so many pixels, drawn from the model."""
    start = np.concatenate([[0], np.cumsum(counts)])
    shade = rng.uniform(0.2, 1, start[-1])
    albedo = np.clip(rng.normal(0.5, 0.3, (len(counts), 3)), 0.02, 1)
    rendered = shade[:, None] * np.repeat(albedo, counts, axis=0)
    is_known = np.zeros(len(counts), np.bool_)
    return whole(start, sample(rng, rendered, noise), shade[:, None], is_known)


@pytest.mark.parametrize("outlier", [0.01, 0.05, 0.2])
def test_albedos_are_integrated_out_exactly(seed: int, outlier: float) -> None:
    """As by sums over 20,000 points, from one pixel to two hundred."""
    noise = ColourNoise(outlier=outlier)
    segments = pixels(np.random.default_rng(seed), [1, 2, 3, 5, 12, 15, 16, 40, 200], noise)
    grid = np.linspace(noise.albedo_mean - 2.4, noise.albedo_mean + 2.4, 20_001)
    prior = stats.norm.logpdf(grid, noise.albedo_mean, noise.albedo_sd)
    expected = []
    for first, last in zip(segments.start[:-1], segments.start[1:], strict=True):
        total = 0.0
        for channel in range(3):
            joint = prior.copy()
            for colour, shade in zip(
                segments.colour[first:last, channel], segments.lit[first:last, 0], strict=True
            ):
                joint += log_density(colour, shade * grid, noise)
            total += np.log(np.exp(joint - joint.max()).sum() * (grid[1] - grid[0])) + joint.max()
        expected.append(total)

    np.testing.assert_allclose(albedo_evidence(segments, noise), expected, atol=1e-8)


def mixed(rng: np.random.Generator, counts: list[int]) -> Segments:
    """Objects that fill parts of their pixels, before others of unknown colours, with edges of their own."""
    count = sum(counts)
    share = rng.uniform(0.05, 1, (count, 1))
    share[rng.random(count) < 0.3] = 1.0
    shade, ground = rng.uniform(0.3, 1, (count, 1)), rng.uniform(0.1, 0.8, (count, 3))
    segments = Segments(
        start=np.concatenate([[0], np.cumsum(counts)]),
        colour=np.zeros((count, 3)),
        lit=shade,
        is_known=np.zeros(len(counts), np.bool_),
        share=share,
        base=(1 - share) * ground,
        variance=((1 - share) * 0.2 * ground) ** 2,
        unresolved=rng.choice([0.0, 0.05], (count, 1)),
    )
    albedo = np.repeat(rng.uniform(0.1, 0.9, (len(counts), 3)), counts, axis=0)
    sd = np.sqrt(segments.variances(albedo, ColourNoise()))
    return replace(segments, colour=sample(rng, segments.own * albedo + segments.base, ColourNoise(), sd))


def test_albedos_of_mixed_pixels_are_integrated_out_exactly(seed: int) -> None:
    """As by sums over 20,000 points: outlines, other things' unknown colours and edges included."""
    noise = ColourNoise()
    segments = mixed(np.random.default_rng(seed), [2, 5, 12, 16, 40, 200])
    grid = np.linspace(noise.albedo_mean - 2.4, noise.albedo_mean + 2.4, 20_001)
    assert segments.variance is not None
    assert segments.unresolved is not None
    expected = []
    for first, last in pairwise(segments.start):
        mine = slice(first, last)
        share, own, rest = segments.share[mine], segments.own[mine], segments.base[mine]
        total = 0.0
        for channel in range(3):
            rendered = own * grid + rest[:, channel, None]
            jump = 4 * noise.coverage * ((1 - share) * own * grid - share * rest[:, channel, None])
            edge = share * segments.unresolved[mine] * grid
            variance = noise.sigma**2 + segments.variance[mine, channel, None] + jump**2 + edge**2
            logs = log_density(segments.colour[mine, channel, None], rendered, noise, np.sqrt(variance))
            joint = logs.sum(axis=0) + stats.norm.logpdf(grid, noise.albedo_mean, noise.albedo_sd)
            total += logsumexp(joint) + np.log(grid[1] - grid[0])
        expected.append(total)

    np.testing.assert_allclose(albedo_evidence(segments, noise), expected, atol=1e-8)


def test_gains_of_known_colours_are_integrated_out_exactly(seed: int) -> None:
    """As by sums over 20,000 logs of gains, from one pixel to two hundred, dark surfaces and bright ones."""
    noise, rng = ColourNoise(), np.random.default_rng(seed)
    counts = [1, 2, 5, 15, 16, 40, 200]
    start = np.concatenate([[0], np.cumsum(counts)])
    lit = rng.uniform(0.02, 1, (start[-1], 3))
    gain = np.exp(rng.normal(0, noise.gain_sd, (len(counts), 3)))
    colour = sample(rng, lit * np.repeat(gain, counts, axis=0), noise)
    segments = whole(start, colour, lit, np.ones(len(counts), np.bool_))
    grid = np.linspace(-8 * noise.gain_sd, 8 * noise.gain_sd, 20_001)
    expected = []
    for first, last in pairwise(start):
        logs = log_density(colour[first:last, :, None], lit[first:last, :, None] * np.exp(grid), noise)
        joint = logs.sum(axis=0) + stats.norm.logpdf(grid, 0, noise.gain_sd)
        expected.append((logsumexp(joint, axis=-1) + np.log(grid[1] - grid[0])).sum())

    np.testing.assert_allclose(albedo_evidence(segments, noise), expected, atol=1e-6)


def test_the_fitted_albedo_is_that_of_most_pixels(seed: int) -> None:
    """Within four of its own standard deviations, outliers left out; Laplace's evidence within 0.1 nat."""
    noise = ColourNoise()
    rng = np.random.default_rng(seed)
    shade = rng.uniform(0.4, 1, 300)
    colour = sample(rng, shade[:, None] * np.array([0.2, 0.5, 0.9]), noise)
    segments = whole(np.array([0, 300]), colour, shade[:, None], UNKNOWN)
    found = fit(segments, noise)

    assert (np.abs(found.factor - [0.2, 0.5, 0.9]) * np.sqrt(found.precision) < 5).all()
    np.testing.assert_allclose(laplace_evidence(segments, noise), albedo_evidence(segments, noise), atol=0.1)


def test_objects_without_pixels_have_no_evidence() -> None:
    """Zero, between others too."""
    noise = ColourNoise()
    start = np.array([0, 0, 2, 2])
    segments = whole(start, np.full((2, 3), 0.4), np.ones((2, 1)), np.zeros(3, np.bool_))

    assert albedo_evidence(segments, noise)[[0, 2]] == pytest.approx([0, 0], abs=1e-6)
    assert laplace_evidence(segments, noise)[[0, 2]].tolist() == [0, 0]
