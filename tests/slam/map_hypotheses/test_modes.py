"""Several maps: alike ones are one, and those that no draw would be of are none."""

from itertools import product

import numpy as np
import pytest

from slam.map_hypotheses.modes import Modes, undiscovered_share


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


@pytest.mark.parametrize(
    ("probabilities", "tolerance"),
    [
        ([1 / 3] * 3, 0.01),
        ([1 / 6] * 6, 0.01),
        ([0.4, 0.3, 0.1, 0.1, 0.1], 0.03),
        ([0.7, 0.1, 0.1, 0.1], 0.07),
    ],
)
def test_what_six_starts_have_not_found_is_told_by_what_they_found_once(
    probabilities: list[float], tolerance: float
) -> None:
    """On average over all outcomes, by enumeration; the bias, of order f2 / n^2, grows with unevenness."""
    optima, starts = np.asarray(probabilities), 6
    outcomes = np.asarray(list(product(range(len(optima)), repeat=starts)))
    probable = optima[outcomes].prod(axis=1)
    times_found = (outcomes[:, :, None] == np.arange(len(optima))).sum(axis=1)

    told = probable @ [undiscovered_share(each) for each in times_found]
    missed = probable @ ((times_found == 0) @ optima)

    assert told == pytest.approx(missed, abs=tolerance)


def test_starts_that_all_end_in_one_map_leave_nothing_open() -> None:
    """One start, or none, tells nothing of the next: all is open."""
    assert undiscovered_share(np.asarray([6, 0])) == 0.0
    assert undiscovered_share(np.asarray([0, 1])) == undiscovered_share(np.zeros(0, int)) == 1.0


def test_maps_found_once_tell_what_the_search_has_missed() -> None:
    """Probabilities of the maps stay; one that has no weight was not found."""
    maps = [_map(0.5 * number) for number in range(4)] + [_map(0.0), _map(1.51)]
    log_weights = [0.0, -100.0, -200.0, np.nan, -1.0, -300.0]

    modes = Modes.of(maps, log_weights, range(1, 6))

    np.testing.assert_array_equal(modes.maps, maps[:1])
    np.testing.assert_array_equal(modes.shares, [1.0])
    assert modes.undiscovered == undiscovered_share(np.asarray([1, 1, 1, 1])) > 0.5
    assert Modes.of(maps, log_weights).undiscovered == 0.0
