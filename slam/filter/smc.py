"""One step of sequential Monte Carlo over discrete histories, which integrate out what is continuous.

A history branches into all that may have happened next, each with the evidence of it; while there are few of
them nothing is drawn, and weights are exact. Else those of little weight are drawn so that no expectation
changes (Rao-Blackwellised particle filters; Doucet et al. 2000; drawing without replacement by Fearnhead and
Clifford 2003). The same code runs in exact toy models and behind the camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import jax
import numpy as np
from numpy.typing import NDArray

H = TypeVar("H")
C = TypeVar("C")


@dataclass(frozen=True)
class Population(Generic[H]):
    """Weighted histories.

    Attributes:
        histories: H.
        log_weights: (H,) whose sum has mean 1; it is 1 where nothing was drawn.
    """

    histories: tuple[H, ...]
    log_weights: NDArray[np.float64]

    def __len__(self) -> int:
        """H."""
        return len(self.histories)

    @property
    def probabilities(self) -> NDArray[np.float64]:
        """(H,) normalised."""
        return np.exp(self.log_weights - np.logaddexp.reduce(self.log_weights))

    @property
    def heaviest(self) -> H:
        """The likeliest history."""
        return self.histories[int(np.argmax(self.log_weights))]


@dataclass(frozen=True)
class StepInfo:
    """What one step did.

    Attributes:
        log_evidence: log p(y_t | y_1..t-1), estimated; its running sum is log of an unbiased estimate.
        ancestors: (H,) index in the previous population of the history that each one goes on.
        resampled: whether some were drawn.
    """

    log_evidence: float
    ancestors: NDArray[np.int32]
    resampled: bool


def certain(history: H) -> Population[H]:
    """One history."""
    return Population((history,), np.zeros(1))


def step(
    key: jax.Array,
    population: Population[H],
    branch: Callable[[int, H], Sequence[tuple[C, float]]],
    most: int,
    least: float,
) -> tuple[Population[C], StepInfo]:
    """Every history's branches, weighed, and at most so many of them.

    Args:
        key: consumed.
        population: before it.
        branch: what may have happened after a history, which has that index, and log p(y_t, that | it). At
            least one of all has a probability.
        most: histories that are kept.
        least: weight under which one is kept with the probability of its share of this, and has then it.
    """
    children: list[tuple[int, C, float]] = []
    for index, history in enumerate(population.histories):
        log_weight = float(population.log_weights[index])
        children += [(index, child, log_weight + log_p) for child, log_p in branch(index, history)]
    log_weights = np.asarray([log_weight for _, _, log_weight in children])
    log_evidence = float(np.logaddexp.reduce(log_weights))
    log_weights = log_weights - log_evidence
    kept, after = thinned(key, log_weights, most, least)
    info = StepInfo(
        log_evidence, np.asarray([children[index][0] for index in kept], np.int32), len(kept) < len(children)
    )
    return Population(tuple(children[index][1] for index in kept), after), info


def thinned(
    key: jax.Array, log_weights: NDArray[np.float64], most: int, least: float
) -> tuple[NDArray[np.int_], NDArray[np.float64]]:
    """Indices (n,) of weights (H,) that are kept, and their log weights, of which no mean has changed.

    Weights over a threshold are kept as they are; of the others as many are drawn, systematically, as they
    are thresholds together, and have its weight. It is the least by which at most `most` are left.
    """
    weights = np.exp(log_weights)
    threshold = max(_threshold(weights, most), min(least, weights.max()))
    light = weights < threshold
    expected = np.cumsum(np.where(light, weights, 0.0)) / max(threshold, np.finfo(float).tiny)
    uniform = float(jax.random.uniform(key))
    drawn = np.floor(expected + uniform) > np.floor(np.append(uniform, expected[:-1] + uniform))
    kept = np.flatnonzero(~light | (light & drawn))
    after = np.array(log_weights)
    after[light] = np.log(threshold) if light.any() else 0.0
    return kept, after[kept]


def _threshold(weights: NDArray[np.float64], most: int) -> float:
    """The weight c by which sum min(w / c, 1) is `most`, 0 where so many are there at most."""
    if len(weights) <= most:
        return 0.0
    ordered = np.sort(weights)
    below = np.cumsum(ordered)
    for count in range(len(weights) - most, len(weights)):
        threshold = below[count] / (most - (len(weights) - 1 - count))
        if count + 1 == len(weights) or threshold <= ordered[count + 1]:
            return float(threshold)
    raise AssertionError("weights are positive")


def merged(
    key: jax.Array, population: Population[H], are_alike: Callable[[H, H], bool]
) -> tuple[Population[H], NDArray[np.int_]]:
    """Of histories with one future one, drawn by their weights, with the weight of all; and which (n,)."""
    left, kept, log_weights = list(range(len(population))), [], []
    for number, one_key in enumerate(jax.random.split(key, len(population))):
        if number not in left:
            continue
        group = [
            other
            for other in left
            if other == number or are_alike(population.histories[number], population.histories[other])
        ]
        left = [other for other in left if other not in group]
        of_group = population.log_weights[group]
        total = float(np.logaddexp.reduce(of_group))
        place = np.searchsorted(np.cumsum(np.exp(of_group - total)), float(jax.random.uniform(one_key)))
        kept.append(group[min(int(place), len(group) - 1)])
        log_weights.append(total)
    survivors = tuple(population.histories[index] for index in kept)
    return replace(population, histories=survivors, log_weights=np.asarray(log_weights)), np.asarray(kept)
