"""The figures of `bench sampler`."""

from unittest.mock import Mock

import numpy as np
import pytest

from pipeline.benchmarks import sampler as bench


def test_distance_is_total_variation() -> None:
    """Half the sum of absolute differences."""
    assert bench._distance(np.array([3, 1]), np.array([0.5, 0.5])) == pytest.approx(0.25)
    assert bench._distance(np.array([2, 2]), np.array([0.5, 0.5])) == 0


@pytest.mark.slow  # compiles the kernel that tests/scene/mcmc/test_structure_sampler.py runs as well
def test_two_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    """A short run is near the enumeration, and every involution returns."""
    monkeypatch.setattr(bench, "OBJECTS", (2,))
    figures = bench.measure_sampler(1, 100_000, Mock())
    document = bench.document_of(figures)
    assert set(document["total_variation"]) == {"2"}
    assert document["trees"] == {"2": 3}
    # Sticks for about 30 moves: standard error about 0.01; 0.06 is six of them.
    assert document["total_variation"]["2"] < 0.06
    assert document["independent_draws"]["2"] < 0.01
    assert document["involution_error"]["2"] < 1e-9
    assert document["seconds"] == figures[2].seconds
