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


def test_a_map_without_a_weight_does_not_displace_the_others() -> None:
    """Where alignment left the numbers; of maps of which none has a weight all are as likely."""
    maps = [_map(0.0), _map(1.0)]

    one, none = Modes.of(maps, [np.nan, -50.0]), Modes.of(maps, [np.nan, -np.inf])

    np.testing.assert_array_equal(one.maps, maps[1:])
    np.testing.assert_allclose(none.shares, [0.5, 0.5])
