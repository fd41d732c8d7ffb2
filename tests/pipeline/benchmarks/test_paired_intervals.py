"""Intervals of paired differences hold the truth as often as they say."""

import numpy as np
from scipy.stats import norm

from pipeline.benchmarks.paired_intervals import compared, interval, paired_difference
from tests.statistical import assert_coverage

DRAWS = 1000


def test_intervals_cover_a_known_difference(seed: int) -> None:
    """60 images of two objects, right with 0.9 and 0.75, objects of an image alike: 95% of 1,000 intervals.

    Exact binomial, false alarm 1e-6; an interval of objects instead of images (0.92) would be seen.
    """
    rng = np.random.default_rng(seed)
    images, objects, first, second = 60, 2, 0.9, 0.75
    covered = 0
    for _ in range(DRAWS):
        shared = rng.normal(size=(images, 1, 1)) * np.sqrt(0.4)
        own = rng.normal(size=(images, objects, 2)) * np.sqrt(0.6)
        place = norm.cdf(shared + own)
        right = place < np.array([first, second])
        differences = (right[..., 0].astype(float) - right[..., 1]).sum(axis=1)
        low, high = interval(differences, np.full(images, objects))
        covered += low <= first - second <= high
    assert 0.93 * DRAWS <= covered <= 0.98 * DRAWS
    assert_coverage(covered, DRAWS, 0.95)


def test_columns_that_never_differ_are_not_certain() -> None:
    """Ten images without a difference leave some room, a thousand hardly any."""
    few, many = (interval(np.zeros(count), np.ones(count)) for count in (10, 1000))
    assert few[0] < -0.1 < 0.1 < few[1]
    assert -0.01 < many[0] < 0 < many[1] < 0.01


def test_only_objects_of_both_columns_are_compared() -> None:
    """What one column lacks is left out."""
    rows = {"a": {"x": True, "y": True, "z": False}, "b": {"x": False, "y": True}}
    difference = compared(rows, "a", "b", {"x": 1, "y": 2, "z": 3})
    assert difference is not None
    assert (difference.share, difference.objects, difference.images) == (0.5, 2, 2)
    assert paired_difference([], [], []) is None
