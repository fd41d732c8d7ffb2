"""Regions where an object may be."""

import numpy as np

from pipeline.publishing.hidden_regions import regions_of


def test_places_far_apart_are_regions_of_their_own(seed: int) -> None:
    """Two heaps and their shares; a region's corners hold its places."""
    rng = np.random.default_rng(seed)
    places = np.concatenate([rng.uniform(0, 0.1, (300, 3)), rng.uniform(0.5, 0.6, (100, 3))])

    first, second = regions_of(0.4, places)

    assert abs(first.probability - 0.3) < 1e-9
    assert abs(second.probability - 0.1) < 1e-9
    assert (first.high_m < 0.1).all()
    assert (second.low_m > 0.5).all()


def test_no_place_is_no_region() -> None:
    """Where there are no draws."""
    assert regions_of(0.4, np.zeros((0, 3))) == []
