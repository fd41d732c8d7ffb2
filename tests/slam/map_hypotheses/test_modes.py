"""Several maps: particles stand for them by their probabilities, and alike ones are one."""

import jax
import numpy as np
import pytest

from slam.map_hypotheses.modes import Modes, assign_modes


def _map(shift_m: float) -> np.ndarray:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1:, 0, 3] = shift_m
    return poses


def test_alike_maps_are_one_and_unlikely_ones_none() -> None:
    """The likeliest of those in the same places stands for them; shares are those of the rest."""
    modes = Modes.of([_map(0.0), _map(1.0), _map(0.01), _map(2.0)], [0.0, np.log(3.0), -1.0, -20.0])

    np.testing.assert_array_equal(modes.maps, [_map(1.0), _map(0.0)])
    np.testing.assert_allclose(modes.shares, [0.75, 0.25])


@pytest.mark.parametrize("uneven", [False, True])
def test_particles_are_dealt_by_the_shares(key: jax.Array, uneven: bool) -> None:
    """Numbers are right to within one, weights exactly, and within a mode they keep their ratios."""
    shares, count = np.asarray([0.61, 0.29, 0.1]), 64
    weights = np.arange(1.0, count + 1) if uneven else np.ones(count)
    before = np.log(weights / weights.sum())

    modes, after = assign_modes(key, shares, before)

    assert (np.abs(np.bincount(modes) - count * shares) < 1).all()
    np.testing.assert_allclose(np.bincount(modes, np.exp(after)), shares)
    for mode in range(3):
        np.testing.assert_allclose(np.ptp((after - before)[modes == mode]), 0.0, atol=1e-9)


def test_one_mode_changes_nothing(key: jax.Array) -> None:
    """Weights stay where there is nothing to choose."""
    before = np.log(np.asarray([0.5, 0.3, 0.2]))

    modes, after = assign_modes(key, np.ones(1), before)

    assert not modes.any()
    np.testing.assert_allclose(after, before)
