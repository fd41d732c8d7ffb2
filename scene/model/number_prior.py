"""Priors on how many objects are there, p(N) of supplement L, as probabilities of sets of slots.

A slot is one copy of a shape that is asked for. Given N every set of N slots is as likely (supplement L,
eq. 5), so that a prior is a table: the probability of one given set, by its size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import betaln, gammaln, xlog1py, xlogy

SHAPES = 2.0
"""Shapes asked for, there or not, that weigh as much as the prior presence does: Beta(2 p, 2 (1 - p)). With
p = 1/2 every number of them is then as probable, which corrects for how many are asked for (Scott and Berger
2010). A large weight would claim to know which share of them is there."""

LOG_SHARE_OF_POSES = -20.0
"""Log prior probability of the poses that fit alike: within about 2 mm and 2 degrees, of all on a table."""

LOG_SPINS = math.log(360 / 4)
"""Log of how many times as many poses fit alike of a shape that is round about a line: it spins freely."""


class NumberPrior(Protocol):
    """p(N), spread evenly over the sets of N slots."""

    def log_set_probabilities(self, slots: int) -> NDArray[np.float64]:
        """Log probability (slots + 1,) that exactly one given set of 0, 1, ... of the slots is there."""
        ...


@dataclass(frozen=True)
class BinomialNumber:
    """Every slot holds its object independently (eq. 3 with one probability, eq. 4).

    Attributes:
        presence: probability of each.
    """

    presence: float

    def __post_init__(self) -> None:
        _check_presence(self.presence)

    def log_set_probabilities(self, slots: int) -> NDArray[np.float64]:
        """p^n (1 - p)^(slots - n)."""
        there = np.arange(slots + 1)
        return xlogy(there, self.presence) + xlog1py(slots - there, -self.presence)


@dataclass(frozen=True)
class UncertainBinomialNumber:
    """Binomial with a presence that is itself uncertain: Beta(w p, w (1 - p)), w = `SHAPES`.

    Where most of what is asked for is missing, each of the others is less probable.

    Attributes:
        presence: p, the mean.
    """

    presence: float

    def __post_init__(self) -> None:
        _check_presence(self.presence)

    def log_set_probabilities(self, slots: int) -> NDArray[np.float64]:
        """Beta function of the counts over that of none."""
        there = np.arange(slots + 1)
        first, second = SHAPES * self.presence, SHAPES * (1 - self.presence)
        return betaln(first + there, second + slots - there) - betaln(first, second)


@dataclass(frozen=True)
class NumberBesideOthers:
    """How many more are there where some are already.

    Attributes:
        number: prior of all.
        others: how many are there.
    """

    number: NumberPrior
    others: int

    def log_set_probabilities(self, slots: int) -> NDArray[np.float64]:
        """Of sets of the further slots, given that the others are taken."""
        with_others = self.number.log_set_probabilities(self.others + slots)[self.others :]
        of_size = with_others + log_choices(slots, np.arange(slots + 1))
        return with_others - np.logaddexp.reduce(of_size)


def _check_presence(presence: float) -> None:
    if not 0 < presence < 1:
        raise ValueError(f"presence must lie between 0 and 1, got {presence}")


def log_choices(things: int, chosen: ArrayLike) -> NDArray[np.float64]:
    """Log numbers (...) of the sets of so many (...) among things."""
    size = np.asarray(chosen)
    return np.asarray(gammaln(things + 1) - gammaln(size + 1) - gammaln(things - size + 1))


def log_prior_odds(presence: float) -> float:
    """Of an object being there in one pose, up to poses that fit alike, against its being absent."""
    return math.log(presence / (1 - presence)) + LOG_SHARE_OF_POSES
