"""The only home of tolerances for random results.

Each assertion states how often it fails on correct code (`false_alarm`) and refuses to run where the
sample is too small to see the error that matters (`detectable`).
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

FALSE_ALARM = 1e-6


def assert_mean(
    samples: ArrayLike, expected: ArrayLike, *, detectable: float, false_alarm: float = FALSE_ALARM
) -> None:
    """The mean over the first axis of independent samples (n, ...) is `expected`.

    Normal approximation with the samples' own standard error, Bonferroni over the other axes. An error
    of `detectable` in any entry would be found at least half the time.
    """
    samples = np.asarray(samples, np.float64)
    count = len(samples)
    standard_error = samples.std(axis=0, ddof=1) / np.sqrt(count)
    error = np.abs(samples.mean(axis=0) - np.asarray(expected))
    limit = stats.t.isf(false_alarm / error.size / 2, count - 1) * standard_error
    assert (limit <= detectable).all(), f"{count} samples see {limit.max():.2g}, not {detectable}"
    assert (error <= limit).all(), f"mean is off by {error.max():.3g}, limit {limit.max():.3g}"


def assert_frequencies(
    counts: ArrayLike, probabilities: ArrayLike, *, false_alarm: float = FALSE_ALARM
) -> None:
    """Independent draws fell into cells with the given probabilities (chi-square, expected counts >= 5)."""
    counts = np.asarray(counts, np.float64).ravel()
    expected = np.asarray(probabilities, np.float64).ravel() * counts.sum()
    assert np.isclose(expected.sum(), counts.sum()), "probabilities must sum to one"
    assert expected.min() >= 5, f"smallest expected count {expected.min():.2g} is below 5"
    p_value = stats.chisquare(counts, expected).pvalue
    assert p_value >= false_alarm, f"chi-square p-value {p_value:.2g}; counts {counts.tolist()}"


def assert_coverage(covered: int, trials: int, level: float, *, false_alarm: float = FALSE_ALARM) -> None:
    """Independent regions of nominal `level` held the truth at that rate (exact binomial)."""
    p_value = stats.binomtest(int(covered), int(trials), level).pvalue
    assert p_value >= false_alarm, f"{covered}/{trials} covered at level {level}, p = {p_value:.2g}"


def assert_uniform(
    samples: ArrayLike, *, low: float = 0.0, high: float = 1.0, false_alarm: float = FALSE_ALARM
) -> None:
    """Independent samples are uniform on [low, high] (Kolmogorov-Smirnov)."""
    p_value = stats.kstest(np.asarray(samples).ravel(), stats.uniform(low, high - low).cdf).pvalue
    assert p_value >= false_alarm, f"Kolmogorov-Smirnov p-value {p_value:.2g}"
