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
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from scene.presence.counts import Visit
from scene.presence.forests import ForestPrior

ABSENT, HIDDEN = -1, -2
"""In place of the number of a slot's candidate."""


BLOCKS, BLOCK = 12, 6
"""Slots of a sweep that are moved with what they overlap most, and slots of such a move at most: three things
that stand for one are open, and that one is not, in a sixteenth of the moves. Search effort: twelve take a
tenth more time than three, and change four times as often what is there (the kitchen's frame 100)."""


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
    """

    layers: Sequence[SlotLayers]
    log_offered: NDArray[np.float64]
    prior: ForestPrior
    log_hidden: NDArray[np.float64]

    @property
    def slots(self) -> int:
        """N."""
        return len(self.log_offered)

    @property
    def count(self) -> int:
        """K."""
        return self.log_offered.shape[1]

    @cached_property
    def _kept_gains(self) -> dict[tuple[int, tuple[tuple[int, int], ...]], NDArray[np.float64]]:
        """Of slots beside what is taken."""
        return {}

    @cached_property
    def shared(self) -> dict[tuple[int, int], tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """Of pairs of slots whose candidates share pixels: where these are in either's own pixels."""
        shared = {}
        for a, b in combinations(range(self.slots), 2):
            pixels = self.layers[a].pixels, self.layers[b].pixels
            both, of_a, of_b = np.intersect1d(*pixels, assume_unique=True, return_indices=True)
            if both.size:
                shared[a, b], shared[b, a] = (of_a, of_b), (of_b, of_a)
        return shared

    @cached_property
    def overlaps(self) -> NDArray[np.float64]:
        """(N, N) how many pixels the candidates of two slots share, 0 on the diagonal."""
        counts = np.zeros((self.slots, self.slots))
        for pair, (here, _) in self.shared.items():
            counts[pair] = here.size
        return counts

    def log_weights(
        self, choice: NDArray[np.integer], slots: Sequence[int], power: float = 1.0
    ) -> NDArray[np.float64]:
        """Log weights (1 + n (K + 1),) of none of n slots, and of each at its candidates and then hidden.

        Args:
            choice: (N,) of all slots; what it says of these does not matter.
            slots: one or two.
            power: of the likelihood.
        """
        rest = np.array(choice)
        rest[list(slots)] = ABSENT
        key = rest.tobytes(), tuple(slots), power
        if key not in self._kept_weights:
            self._kept_weights[key] = self._log_weights(rest, slots, power)
        return self._kept_weights[key]

    @cached_property
    def _kept_weights(self) -> dict[tuple[bytes, tuple[int, ...], float], NDArray[np.float64]]:
        """Where one thing is certain moves come to the same scenes again and again."""
        return {}

    def _log_weights(
        self, rest: NDArray[np.integer], slots: Sequence[int], power: float
    ) -> NDArray[np.float64]:
        """The same, computed, of slots beside the rest (N,) of the scene."""
        taken, hidden = _there(rest)
        parts = [np.array([self.prior.log_density(taken, hidden)])]
        for slot in slots:
            log_prior = self.prior.log_densities(taken, slot, hidden)
            log_seen = (
                log_prior + power * self._gains(taken, slot) - self.log_offered[slot] - np.log(self.count)
            )
            unseen = self.prior.log_density(taken, hidden + 1) + self.log_hidden[slot]
            parts.append(np.append(log_seen, unseen))
        return np.concatenate(parts)

    def log_prior(self, choice: NDArray[np.integer]) -> float:
        """Log prior of a scene (N,)."""
        return self.prior.log_density(*_there(choice))

    def log_likelihood(self, choice: NDArray[np.integer]) -> float:
        """Log likelihood of a scene (N,) over that of the empty one, in sight."""
        taken: list[tuple[int, int]] = []
        total = 0.0
        for slot in np.flatnonzero(choice >= 0).tolist():
            total += self._gains(taken, slot)[choice[slot]]
            taken.append((slot, int(choice[slot])))
        return float(total)

    def _gains(self, taken: Sequence[tuple[int, int]], slot: int) -> NDArray[np.float64]:
        """(K,) what each candidate adds to the log likelihood of what is taken."""
        beside = tuple(one for one in taken if (slot, one[0]) in self.shared)
        if (slot, beside) not in self._kept_gains:
            self._kept_gains[slot, beside] = self._gains_beside(beside, slot)
        return self._kept_gains[slot, beside]

    def _gains_beside(self, taken: Sequence[tuple[int, int]], slot: int) -> NDArray[np.float64]:
        """The same, computed, beside what shares pixels with the slot."""
        mine = self.layers[slot]
        front_m = np.full(len(mine.pixels), np.inf, np.float32)
        gain = np.zeros(len(mine.pixels), np.float32)
        first = np.full(len(mine.pixels), self.slots)
        for other, place in taken:
            theirs, (here, there) = self.layers[other], self.shared[slot, other]
            nearer = theirs.depth_m[place, there] < front_m[here]  # of equally near ones the first counts
            here, there = here[nearer], there[nearer]
            front_m[here], gain[here] = theirs.depth_m[place, there], theirs.log_gain[place, there]
            first[here] = other
        before = mine.depth_m < np.where(first > slot, np.nextafter(front_m, np.float32(np.inf)), front_m)
        return np.where(before, mine.log_gain - gain, 0).sum(axis=1, dtype=np.float64)


def _there(choice: NDArray[np.integer]) -> tuple[list[tuple[int, int]], int]:
    """The slots of a scene (N,) that are in sight, with their candidates, and how many are hidden."""
    taken = [(int(one), int(choice[one])) for one in np.flatnonzero(choice >= 0)]
    return taken, int((choice == HIDDEN).sum())


def toggled(
    rng: np.random.Generator,
    candidates: Candidates,
    choice: NDArray[np.integer],
    slots: Sequence[int],
    expected: NDArray[np.float64],
    power: float = 1.0,
) -> NDArray[np.integer]:
    """The scene (N,) after a move of one slot or two.

    Args:
        rng: random numbers.
        candidates: of all slots.
        choice: (N,) the scene before.
        slots: that are moved.
        expected: (N, 3) gets sums over moves: of probabilities of being there, of being hidden, and of 1.
        power: of the likelihood.
    """
    expected[slots, 2] += 1
    there = choice[slots] != ABSENT
    if there.all() and len(slots) > 1:
        expected[slots, 0] += 1
        expected[slots, 1] += choice[slots] == HIDDEN
        return choice
    chances = softmax(candidates.log_weights(choice, slots, power))
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


def reseated(
    rng: np.random.Generator,
    candidates: Candidates,
    choice: NDArray[np.integer],
    slots: Sequence[int],
    power: float = 1.0,
) -> NDArray[np.integer]:
    """The scene (N,) after a move of several slots at once, for three things that take one's place.

    Of the slots a random half is open: one after the other takes what its options say, given those before;
    the others are empty. That is an independence proposal x' with density q(x' | open). For the way back
    `open` is drawn from those that allow the present scene x: on the space of scenes and what was open the
    move is Metropolised, by pi(x') q(x | open) 2^n(x') / (pi(x) q(x' | open') 2^n(x)), n the slots taken.

    Args:
        rng: random numbers.
        candidates: of all slots.
        choice: (N,) the scene before.
        slots: that are moved, drawn whatever the state.
        power: of the likelihood.
    """
    order = rng.permutation(slots)
    log_ratio, ends = 0.0, []
    for present, sign in ((choice, -1), (None, 1)):
        taken = np.zeros(len(order), bool) if present is None else present[order] != ABSENT
        is_open = taken | (rng.random(len(order)) < 0.5)
        scene = np.array(choice)
        scene[order] = ABSENT
        log_worth = candidates.log_prior(scene)  # pi / q, up to what the rest is worth
        for number, slot in enumerate(order[is_open].tolist()):
            weights = candidates.log_weights(scene, [slot], power)
            option = 0 if present is None else _option(candidates, int(present[slot]))
            log_total = np.logaddexp.reduce(weights)
            if log_total == -np.inf or (present is not None and weights[option] == -np.inf):
                return np.array(choice)  # as what rests on something that is not yet there
            if present is None:
                option = rng.choice(len(weights), p=softmax(weights))
            log_worth = log_total + (log_worth - weights[0] if number else 0.0)  # without all it may be 0
            scene[slot] = _choice(candidates, option)
        log_ratio += sign * (log_worth + (scene[order] != ABSENT).sum() * np.log(2))
        ends.append(scene)
    return ends[1] if np.log(rng.random()) < log_ratio else np.array(choice)


def _option(candidates: Candidates, chosen: int) -> int:
    """The place of a slot's choice among its options: absent, its candidates, hidden."""
    return {ABSENT: 0, HIDDEN: candidates.count + 1}.get(chosen, chosen + 1)


def _choice(candidates: Candidates, option: int) -> int:
    """The choice that stands in a place among the options."""
    return {0: ABSENT, candidates.count + 1: HIDDEN}.get(option, option - 1)


def toggle(
    rng: np.random.Generator,
    candidates: Candidates,
    choice: NDArray[np.integer],
    sweeps: int,
    power: float = 1.0,
    visits: list[Visit] | None = None,
) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
    """A scene (N,) after moves among candidates, and sums (N, 3) as `toggled` tells them.

    A sweep moves every slot by itself, as many pairs of those that may be taken for each other, and some
    slots with others, drawn by how many pixels they share. What moves of one slot knew is added to `visits`.
    """
    expected = np.zeros((candidates.slots, 3))
    pairs = [pair for pair in candidates.shared if pair[0] < pair[1]]
    for _ in range(sweeps):
        for slot in range(candidates.slots):
            before = expected[slot, 0]
            choice = toggled(rng, candidates, choice, [slot], expected, power)
            if visits is not None:
                others = (choice != ABSENT) & (np.arange(len(choice)) != slot)
                visits.append(Visit(slot, float(expected[slot, 0] - before), others))
        for number in rng.permutation(len(pairs))[: candidates.slots]:
            choice = toggled(rng, candidates, choice, list(pairs[number]), expected, power)
        for slot in rng.choice(candidates.slots, BLOCKS).tolist():
            others = _drawn_beside(rng, candidates, slot)
            if len(others):
                choice = reseated(rng, candidates, choice, [slot, *others.tolist()], power)
    return choice, expected


def _drawn_beside(rng: np.random.Generator, candidates: Candidates, slot: int) -> NDArray[np.integer]:
    """Slots (n,) that overlap with one, each sooner the more pixels it shares, whatever the scene."""
    shares = candidates.overlaps[slot]
    count = min(BLOCK - 1, np.count_nonzero(shares))
    if not count:
        return np.zeros(0, np.intp)
    return rng.choice(candidates.slots, count, replace=False, p=shares / shares.sum())
