"""Moves that change which objects are there: birth, death, swap and relocation in one.

A slot holds one copy of a shape or nothing. Every slot has K candidate poses y_k, drawn from q_c; where the
slot is taken its pose stands for one of them. Given all candidates the law of the scene is discrete, in
proportion to

    pi(scene) / prod over slots c that are taken (K q_c(y_k)),

since the density of all candidates drawn is common to the scenes; drawing them anew but for those in use
leaves pi invariant (an ensemble of candidates: Neal 2003; particle Gibbs). Of a pair of slots {a, b}, drawn
whatever the state, the options are: neither is there, a at one of its candidates, b at one of its; one is
chosen by its probability. Nothing is done where both are there. A slot alone has its absence and its
candidates. As a scene's density is a sum over pixels of layers that are computed once, many moves are made
between two draws. What is carried by another may be moved and removed like any: graphs are summed out.

A slot may also be taken out of sight, where images stay as they are: one more option.

Presence is the mean over moves of its probability among the options (Rao-Blackwell).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from scene.presence.forests import ForestPrior

ABSENT, HIDDEN = -1, -2
"""In place of the number of a slot's candidate."""


@dataclass(frozen=True, eq=False)
class SlotLayers:
    """What a slot's K candidates show, at the pixels that any of them has a part in.

    Attributes:
        pixels: (P,) of all X, increasing.
        depth_m: (K, P) at which they hide others, +inf where they show nothing.
        log_gain: (K, P) log density of the pixel there, less that of the scene without objects.
    """

    pixels: NDArray[np.intp]
    depth_m: NDArray[np.float32]
    log_gain: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Candidates:
    """The candidates of N slots, ready for moves among them.

    Attributes:
        layers: of each slot.
        log_offered: (N, K) log q.
        prior: of sets and poses.
        log_hidden: (N,) log of the mean over prior poses of what being there unseen does to the likelihood;
            -inf where that is left out.
        pixels: X.
    """

    layers: Sequence[SlotLayers]
    log_offered: NDArray[np.float64]
    prior: ForestPrior
    log_hidden: NDArray[np.float64]
    pixels: int

    @property
    def slots(self) -> int:
        """N."""
        return len(self.log_offered)

    @property
    def count(self) -> int:
        """K."""
        return self.log_offered.shape[1]

    def overlapping(self) -> list[tuple[int, int]]:
        """Pairs of slots whose candidates share pixels; that depends on no choice among them."""
        pairs = zip(*np.triu_indices(self.slots, 1), strict=True)
        pixels = [one.pixels for one in self.layers]
        return [
            (int(a), int(b))
            for a, b in pairs
            if np.intersect1d(pixels[a], pixels[b], assume_unique=True).size
        ]

    def log_weights(self, choice: NDArray[np.integer], slots: Sequence[int]) -> NDArray[np.float64]:
        """Log weights (1 + n (K + 1),) of none of n slots, and of each at its candidates and then hidden.

        Args:
            choice: (N,) of all slots; what it says of these does not matter.
            slots: one or two.
        """
        rest = np.array(choice)
        rest[list(slots)] = ABSENT
        taken = [(int(one), int(rest[one])) for one in np.flatnonzero(rest >= 0)]
        hidden = int((rest == HIDDEN).sum())
        parts = [np.array([self.prior.log_density(taken, hidden)])]
        for slot in slots:
            log_prior = self.prior.log_densities(taken, slot, hidden)
            log_seen = log_prior + self._gains(taken, slot) - self.log_offered[slot] - np.log(self.count)
            unseen = self.prior.log_density(taken, hidden + 1) + self.log_hidden[slot]
            parts.append(np.append(log_seen, unseen))
        return np.concatenate(parts)

    def log_density(self, choice: NDArray[np.integer]) -> float:
        """Log density of a scene (N,) in proportion to which it is among the candidates."""
        scene = np.full(self.slots, ABSENT)
        log_density = self.prior.log_density([], 0)
        for slot, place in enumerate(choice):
            if place != ABSENT:
                weights = self.log_weights(scene, [slot])
                log_density += weights[1 + (place if place >= 0 else self.count)] - weights[0]
                scene[slot] = place
        return float(log_density)

    def _gains(self, taken: Sequence[tuple[int, int]], slot: int) -> NDArray[np.float64]:
        """(K,) what each candidate adds to the log likelihood of what is taken."""
        mine = self.layers[slot]
        front_m = np.full(self.pixels, np.inf, np.float32)
        gain = np.zeros(self.pixels, np.float32)
        first = np.full(self.pixels, self.slots)
        for other, place in taken:
            theirs = self.layers[other]
            nearer = theirs.depth_m[place] < front_m[theirs.pixels]  # of equally near ones the first counts
            where = theirs.pixels[nearer]
            front_m[where], gain[where] = theirs.depth_m[place, nearer], theirs.log_gain[place, nearer]
            first[where] = other
        front_m, gain, first = (part[mine.pixels] for part in (front_m, gain, first))
        before = mine.depth_m < np.where(first > slot, np.nextafter(front_m, np.float32(np.inf)), front_m)
        return np.where(before, mine.log_gain - gain, 0).sum(axis=1, dtype=np.float64)


def toggled(
    rng: np.random.Generator,
    candidates: Candidates,
    choice: NDArray[np.integer],
    slots: Sequence[int],
    expected: NDArray[np.float64],
) -> NDArray[np.integer]:
    """The scene (N,) after a move of one slot or two.

    Args:
        rng: random numbers.
        candidates: of all slots.
        choice: (N,) the scene before.
        slots: that are moved.
        expected: (N, 3) gets sums over moves: of probabilities of being there, of being hidden, and of 1.
    """
    expected[slots, 2] += 1
    there = choice[slots] != ABSENT
    if there.all() and len(slots) > 1:
        expected[slots, 0] += 1
        expected[slots, 1] += choice[slots] == HIDDEN
        return choice
    chances = softmax(candidates.log_weights(choice, slots))
    each = chances[1:].reshape(len(slots), -1)
    expected[slots, 0] += each.sum(axis=1)
    expected[slots, 1] += each[:, -1]
    drawn = rng.choice(len(chances), p=chances)
    choice = np.array(choice)
    choice[slots] = ABSENT
    if drawn:
        number, place = divmod(drawn - 1, candidates.count + 1)
        choice[slots[number]] = HIDDEN if place == candidates.count else place
    return choice


def toggle(
    rng: np.random.Generator, candidates: Candidates, choice: NDArray[np.integer], sweeps: int
) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
    """A scene (N,) after moves among candidates, and sums (N, 3) as `toggled` tells them.

    A sweep moves every slot by itself, and as many pairs of those that may be taken for each other.
    """
    expected = np.zeros((candidates.slots, 3))
    pairs = candidates.overlapping()
    for _ in range(sweeps):
        for slot in range(candidates.slots):
            choice = toggled(rng, candidates, choice, [slot], expected)
        for number in rng.permutation(len(pairs))[: candidates.slots]:
            choice = toggled(rng, candidates, choice, list(pairs[number]), expected)
    return choice, expected
