"""What the images say of which objects are there: moves among candidates that are drawn anew between them.

Candidates are drawn from Gaussians round the refined poses of an object, and round other places that the
search had for it. Every chain has candidates of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from scene.hidden.hidden_places import HiddenPlaces
from scene.presence.counts import Copies, Visit, number_probabilities
from scene.presence.depth_candidates import PresenceFrames, candidates_of
from scene.presence.pose_priors import PosePriors
from scene.presence.solids import SolidFits
from scene.presence.state_mixture import StateMixture
from scene.presence.toggling import ABSENT, Candidates, toggle

CANDIDATES = 24
"""K of a slot: what it takes to render them is what presence takes."""

DRAWN, SWEEPS = 3, 8
"""How often candidates are drawn in a chain, and sweeps with each."""

DOUBT = 0.02
"""Of presence in sight: of slots in doubt, as of two that stand for each other, more candidates are drawn."""
DRAWN_AGAIN, SWEEPS_AGAIN = 16, 2
"""How often, and sweeps with each: the density is rough by two nats, so that one candidate in thirty counts,
and what two dozen tell of an object's evidence has a standard deviation of 1.5 nats (YCB-Video's 0001/7)."""

SCENES, ANNEALED = 8, 2.0 ** np.array([-5, -4, -3, -2, -1, 0, 0])
"""Scenes with which a chain begins, and powers of the likelihood in their sweeps: what explains most comes
first, and what explains a part of that finds it taken."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Presence:
    """Which of N objects are there.

    Attributes:
        probability: (N,).
        number: (N, N + 1) probabilities that so many are there of the shape of each.
        standard_error: (N,) of it, from how chains differ, and from the draws of hidden poses.
        hidden: (N,) probability that each is there and not in sight.
        out_of_sight: (N,) probability that each is there, given that it is not in sight.
        out_of_sight_error: (N,) standard error of that.
        seen: (N,) which are more probably there in sight than not.
        poses: (N, 7) world_from_box of these, of one chain as far as it has them.
    """

    probability: NDArray[np.float64]
    number: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    hidden: NDArray[np.float64]
    out_of_sight: NDArray[np.float64]
    out_of_sight_error: NDArray[np.float64]
    seen: NDArray[np.bool_]
    poses: NDArray[np.float64]

    def without_sight_of(self, left: NDArray[np.bool_], alike: NDArray[np.bool_]) -> Presence:
        """The same where some objects (N,) are not in sight; `alike` as of `with_exact`.

        Of copies of a shape as many are there as are told to be: in order, as `Copies` has them.
        """
        told, number = np.where(left, self.out_of_sight, self.probability), self.number.copy()
        error = np.where(left, self.out_of_sight_error, self.standard_error)
        hidden = np.where(left, self.out_of_sight, self.hidden)
        for one in np.flatnonzero((alike & left).any(axis=1)):
            at_least = np.sort(told[alike[one]])[::-1]
            number[one] = 0.0
            number[one, : len(at_least) + 1] = -np.diff(at_least, prepend=1.0, append=0.0)
        seen = self.seen & ~left
        return replace(self, probability=told, standard_error=error, hidden=hidden, number=number, seen=seen)

    def with_exact(
        self, exact: Mapping[int, tuple[float, float]], both: float, alike: NDArray[np.bool_]
    ) -> Presence:
        """The same with exact presence and standard error of some objects that are out of sight.

        Args:
            exact: of one object or two, by number.
            both: probability that both are there, of two.
            alike: (N, N) which objects are copies of one shape, each of itself.
        """
        told, error, number = self.probability.copy(), self.standard_error.copy(), self.number.copy()
        hidden = self.hidden.copy()
        for one, (presence, standard_error) in exact.items():
            told[one], error[one], hidden[one] = presence, standard_error, presence
        for one in exact:
            copies = np.flatnonzero(alike[one])
            if set(copies.tolist()) <= set(exact):
                all_there = both if len(copies) == 2 else 0.0
                one_there = told[copies].sum() - 2 * all_there
                number[one] = 0.0
                number[one, :2] = 1 - one_there - all_there, one_there
                number[one, len(copies)] += all_there
        return replace(self, probability=told, standard_error=error, hidden=hidden, number=number)


@dataclass(frozen=True, kw_only=True, eq=False)
class Ensemble:
    """A scene among candidates that its slots may take.

    Attributes:
        states: (N, K, ...) of the candidates.
        shapes: (N, K) which draws of their shapes they have.
        candidates: what they show.
        choice: (N,) the scene.
    """

    states: NDArray[np.float64]
    shapes: NDArray[np.integer]
    candidates: Candidates
    choice: NDArray[np.integer]

    @classmethod
    def of(
        cls,
        states: NDArray,
        shapes: NDArray[np.integer],
        candidates: Candidates,
        before: Ensemble | None,
        anew: NDArray[np.bool_] | bool = True,
    ) -> Ensemble:
        """The scene that was before, with the first of candidates that are `anew`; else the empty one."""
        choice = np.full(candidates.slots, ABSENT)
        if before is not None:
            choice = np.where(before.in_use & anew, 0, before.choice)
        return cls(states=states, shapes=shapes, candidates=candidates, choice=choice)

    @property
    def in_use(self) -> NDArray[np.bool_]:
        """(N,) which slots are in sight."""
        return self.choice >= 0

    @property
    def chosen(self) -> NDArray[np.float64]:
        """(N, ...) states of the scene; of what is not in use any."""
        return self.states[self._in_scene]

    @property
    def chosen_shapes(self) -> NDArray[np.integer]:
        """(N,) draws of shapes that the scene has."""
        return self.shapes[self._in_scene]

    @property
    def _in_scene(self) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
        return np.arange(len(self.choice)), np.maximum(self.choice, 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Births:
    """What candidates are drawn from.

    Attributes:
        mixture: of the objects.
        solids: unknown things that may be there in their place.
    """

    mixture: StateMixture
    solids: SolidFits


DrawEnsemble = Callable[[Ensemble | None], Ensemble]
"""Candidates drawn anew, the scene as before; the empty one if none was."""


def first_scene(rng: np.random.Generator, candidates: Candidates) -> NDArray[np.integer]:
    """A scene (N,) from the empty one, by population annealing (Hukushima and Iba 2003).

    Scenes are moved with growing powers of the likelihood and drawn by what each step makes of their
    weights, so that the one that is left is seldom in a lesser mode.
    """
    scenes, before = np.full((SCENES, candidates.slots), ABSENT), 0.0
    for power in ANNEALED:
        gain = (power - before) * np.array([candidates.log_likelihood(one) for one in scenes])
        scenes, before = scenes[rng.choice(SCENES, SCENES, p=softmax(gain))], power
        scenes = np.stack([toggle(rng, candidates, one, 1, power)[0] for one in scenes])
    return scenes[0]


def chain_presence(
    rng: np.random.Generator,
    draw: DrawEnsemble,
    first: Ensemble | None = None,
    drawings: int = DRAWN,
    sweeps: int = SWEEPS,
) -> tuple[NDArray[np.float64], Ensemble, list[Visit]]:
    """Presence (N, 2) by a chain, all and hidden, its last scene, and visits.

    Args:
        rng: random numbers.
        draw: draws candidates anew.
        first: scene; None begins with the empty one.
        drawings: of candidates.
        sweeps: with each.
    """
    ensemble, sums, visits = first, np.zeros(()), list[Visit]()
    for _ in range(drawings):
        begins, ensemble = ensemble is None, draw(ensemble)
        choice = first_scene(rng, ensemble.candidates) if begins else ensemble.choice
        choice, expected = toggle(rng, ensemble.candidates, choice, sweeps, visits=visits)
        ensemble, sums = replace(ensemble, choice=choice), sums + expected
    assert ensemble is not None
    return sums[:, :2] / sums[:, 2:], ensemble, visits


def drawn_ensemble(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    births: Births,
    log_hidden: NDArray[np.float64],
    before: Ensemble | None,
    slots: NDArray[np.bool_] | None = None,
) -> Ensemble:
    """Candidates of objects and then of solids; states are (N, K, 10).

    A shape is drawn with each pose, and stays with the pose that is in use.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of poses.
        births: what they are drawn from.
        log_hidden: as `candidates_of` takes it.
        before: the scene, which stays.
        slots: (N,) which get other candidates; None for all.
    """
    solids = births.solids
    states = np.concatenate([births.mixture.drawn(rng, CANDIDATES), solids.drawn(rng, CANDIDATES)])
    shapes = frames.drawn_shapes(rng, states.shape[:2])
    anew = np.ones(len(states), bool) if slots is None else slots
    if before is not None:
        states = np.where(anew[:, None, None], states, before.states)
        shapes = np.where(anew[:, None], shapes, before.shapes)
        kept = before.in_use & anew
        states[kept, 0], shapes[kept, 0] = before.chosen[kept], before.chosen_shapes[kept]
    log_offered = _log_offered(births, states, before, anew)
    given = states, shapes, solids.is_round, log_offered, log_hidden
    candidates = candidates_of(frames, priors, *given, before and before.candidates, anew)
    return Ensemble.of(states, shapes, candidates, before, anew)


def _log_offered(
    births: Births,
    states: NDArray[np.float64],
    before: Ensemble | None,
    anew: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Log densities (N, K) by which states (N, K, 10) were drawn; those that are not anew keep theirs."""
    log_offered = np.zeros(states.shape[:2]) if before is None else before.candidates.log_offered.copy()
    mixture, solids = births.mixture, births.solids
    of_objects, of_solids = np.split(anew, [len(mixture.centres)])
    objects, solid_states = np.split(states[anew], [int(of_objects.sum())])
    log_offered[anew] = np.concatenate(
        [
            mixture.only(of_objects).log_density(objects),
            solids.log_density(solid_states, solids.is_round[of_solids]),
        ]
    )
    return log_offered


def presence_posterior(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    births: Sequence[Births],
    chains: int,
    hidden: HiddenPlaces,
    alike: NDArray[np.bool_],
    found: NDArray[np.bool_],
) -> Presence:
    """Presence of N objects by chains that start with the empty scene.

    Of the copies of a shape the first, those that the search found, are there that many are there.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of sets and poses.
        births: what candidates are drawn from: the first of them for the first chain, ..., over and over.
        chains: how many.
        hidden: what objects do to the likelihood out of sight.
        alike: (N, N) which objects are of one shape.
        found: (N,) which the search found.
    """
    with np.errstate(divide="ignore"):
        log_hidden = np.log(hidden.share)
    objects, kinds = len(alike), len(births)
    draw_of = [partial(drawn_ensemble, rng, frames, priors, one, log_hidden) for one in births]
    draws = [draw_of[chain % kinds] for chain in range(chains)]
    runs = [chain_presence(rng, draw) for draw in draws]
    slots = _in_doubt([told[:, 0] - told[:, 1] for told, _, _ in runs], objects, kinds)
    if slots[0][:objects].any():
        again = [partial(draw, slots=mine) for draw, mine in zip(draws, slots, strict=True)]
        lasts = [last for _, last, _ in runs]
        runs = [
            chain_presence(rng, *one, DRAWN_AGAIN, SWEEPS_AGAIN) for one in zip(again, lasts, strict=True)
        ]
    by_chain, last, visits = zip(*runs, strict=True)
    there, unseen = np.moveaxis(np.stack([one[:objects] for one in by_chain]), 2, 0)
    copies = Copies.of(alike, found)
    in_sight = copies.shared(there - unseen)
    there = copies.with_number(there, np.stack([number_probabilities(run, alike) for run in visits]))
    told, seen = there.mean(axis=0), in_sight.mean(axis=0) >= 0.5
    unseen_share = (told - in_sight.mean(axis=0)).clip(0)
    of_share = unseen_share * (1 - told) * hidden.share_std / np.where(hidden.share > 0, hidden.share, 1)
    not_in_sight = _or_one(1 - in_sight.mean(axis=0))
    out_of_sight = ((there - in_sight) / _or_one(1 - in_sight)).clip(0, 1)
    poses = np.stack([one.chosen[:objects, :7] for one in last])
    in_use = np.stack([one.in_use[:objects] for one in last])
    return Presence(
        probability=told,
        number=number_probabilities([one for run in visits for one in run], alike),
        standard_error=np.hypot(_error_of_mean(there), of_share),
        hidden=unseen_share,
        out_of_sight=(unseen_share / not_in_sight).clip(0, 1),
        out_of_sight_error=np.hypot(_error_of_mean(out_of_sight), of_share / not_in_sight),
        seen=seen,
        poses=_in_one_scene(*copies.in_order(poses, in_use), seen),
    )


def _or_one(divisors: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same where they are positive, else one: what they divide is zero there."""
    return np.where(divisors > 0, divisors, 1)


def _error_of_mean(by_chain: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard error (N,) of the mean over chains (C, N)."""
    return by_chain.std(axis=0, ddof=1) / np.sqrt(len(by_chain))


def _in_doubt(in_sight: Sequence[NDArray[np.float64]], objects: int, kinds: int) -> list[NDArray[np.bool_]]:
    """Which slots of each chain are neither seen for certain nor certainly not: of objects the same in all.

    Args:
        in_sight: of C chains presence in sight (N + U,), N objects and then the solids of a kind of chains.
        objects: N.
        kinds: after how many chains these have the same solids again.
    """

    def is_open(chains: Sequence[NDArray[np.float64]]) -> NDArray[np.bool_]:
        mean = np.mean(chains, axis=0)
        return (mean > DOUBT) & (mean < 1 - DOUBT)

    of_objects = is_open([one[:objects] for one in in_sight])
    of_solids = [is_open(in_sight[kind::kinds])[objects:] for kind in range(min(kinds, len(in_sight)))]
    return [np.append(of_objects, of_solids[chain % kinds]) for chain in range(len(in_sight))]


def _in_one_scene(
    poses: NDArray[np.float64], in_use: NDArray[np.bool_], seen: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Poses (N, 7) of the chain that agrees best with what is seen (N,), of C chains (C, N, 7).

    What it lacks is from the next best that has it.
    """
    order = np.argsort(-(in_use == seen).sum(axis=1), kind="stable")
    first = in_use[order].argmax(axis=0)
    return poses[order][first, np.arange(len(seen))]
