"""Priors on the number of objects against SciPy's distributions."""

import numpy as np
import pytest
from scipy import stats
from scipy.special import comb

from scene.model.number_prior import (
    BinomialNumber,
    NumberBesideOthers,
    NumberPrior,
    UncertainBinomialNumber,
)

SLOTS = 5
COUNTS = np.arange(SLOTS + 1)


@pytest.mark.parametrize(
    ("prior", "expected"),
    [
        (BinomialNumber(0.3), stats.binom.pmf(COUNTS, SLOTS, 0.3)),
        (UncertainBinomialNumber(0.9), stats.betabinom.pmf(COUNTS, SLOTS, 1.8, 0.2)),
    ],
)
def test_the_number_of_objects_has_its_distribution(prior: NumberPrior, expected: np.ndarray) -> None:
    """Every set of one size is as likely, so that the number's law is the table times the number of sets."""
    table = np.exp(prior.log_set_probabilities(SLOTS))

    np.testing.assert_allclose(table * comb(SLOTS, COUNTS), expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("presence", [0.0, 1.0, -0.1, float("nan")])
def test_a_presence_lies_between_0_and_1(presence: float) -> None:
    """Else the message tells what was given."""
    with pytest.raises(ValueError, match=f"between 0 and 1, got {presence}"):
        BinomialNumber(presence)


def test_slots_beside_others_have_the_law_given_that_these_are_taken() -> None:
    """Against the joint law of all slots, for any prior; of independent slots the others tell nothing."""
    for number in (UncertainBinomialNumber(0.9), UncertainBinomialNumber(0.3), BinomialNumber(0.6)):
        of_all, sets = number.log_set_probabilities(5), np.array([1.0, 2.0, 1.0])
        given = np.exp(of_all[3:]) / (sets * np.exp(of_all[3:])).sum()

        beside = NumberBesideOthers(number, 3).log_set_probabilities(2)

        np.testing.assert_allclose(np.exp(beside), given)
    np.testing.assert_allclose(np.exp(beside), [0.16, 0.24, 0.36])
