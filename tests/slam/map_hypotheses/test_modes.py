"""Several maps: alike ones are one, and those that no draw would be of are none."""

import numpy as np

from slam.map_hypotheses.modes import Modes


def _map(shift_m: float) -> np.ndarray:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1:, 0, 3] = shift_m
    return poses


def test_alike_maps_are_one_and_unlikely_ones_none() -> None:
    """The likeliest of those in the same places stands for them; shares are those of the rest."""
    modes = Modes.of([_map(0.0), _map(1.0), _map(0.01), _map(2.0)], [0.0, np.log(3.0), -1.0, -20.0])

    np.testing.assert_array_equal(modes.maps, [_map(1.0), _map(0.0)])
    np.testing.assert_allclose(modes.shares, [0.75, 0.25])
