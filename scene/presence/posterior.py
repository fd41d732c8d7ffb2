"""What the images say of which objects are there: moves among candidates that are drawn anew between them.

Where chains have been, candidates are drawn from what they learned of an object's pose; elsewhere from
Gaussians round the places that the search had for it. Every chain has candidates of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from scene.hidden.hidden_places import HiddenPlaces
from scene.presence.counts import Visit, number_probabilities
from scene.presence.depth_candidates import PresenceFrames, candidates_of
from scene.presence.pose_priors import PosePriors
from scene.presence.solids import SolidFits
from scene.presence.state_mixture import StateMixture
from scene.presence.toggling import ABSENT, Candidates, toggle

CANDIDATES = 24
"""K of a slot: of draws from a fitted Gaussian in six dimensions a third or so then counts."""

DRAWN, SWEEPS = 3, 8
"""How often candidates are drawn in a chain, and sweeps with each."""

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
        seen: (N,) which are more probably there in sight than not.
        poses: (N, 7) world_from_box of these, of one chain as far as it has them.
    """

    probability: NDArray[np.float64]
    number: NDArray[np.float64]
    standard_error: NDArray[np.float64]
    seen: NDArray[np.bool_]
    poses: NDArray[np.float64]


DrawCandidates = Callable[[NDArray[np.float64], NDArray[np.bool_]], tuple[NDArray[np.float64], Candidates]]
"""Poses (N, K, 7), of which the first is a given one (N, 7) where that is kept (N,), and what they show."""


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
    draw: DrawCandidates,
    poses: NDArray[np.float64],
    drawings: int = DRAWN,
    sweeps: int = SWEEPS,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_], list[Visit]]:
    """Presence (N, 2) by a chain from the empty scene, all and hidden, last states, in use or not, visits.

    Args:
        rng: random numbers.
        draw: draws candidates anew.
        poses: (N, ...) of what is not there, any.
        drawings: of candidates.
        sweeps: with each.
    """
    choice, sums, visits = np.full(len(poses), ABSENT), np.zeros((len(poses), 3)), list[Visit]()
    for drawing in range(drawings):
        drawn, candidates = draw(poses, choice >= 0)
        choice = np.where(choice >= 0, 0, choice)
        if drawing == 0:
            choice = first_scene(rng, candidates)
        choice, expected = toggle(rng, candidates, choice, sweeps, visits=visits)
        poses = drawn[np.arange(len(poses)), np.maximum(choice, 0)]
        sums += expected
    return sums[:, :2] / sums[:, 2:], poses, choice >= 0, visits


def drawn_candidates(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    mixture: StateMixture,
    solids: SolidFits,
    log_hidden: NDArray[np.float64],
    states: NDArray[np.float64] | None = None,
    kept: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float64], Candidates]:
    """States (N, K, 10) of objects and then of solids, and what they show.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of poses.
        mixture: of the objects.
        solids: unknown ones.
        log_hidden: as `candidates_of` takes it.
        states: (N, 10), the first ones where they are `kept` (N,); None keeps none.
        kept: which are.
    """
    drawn = np.concatenate([mixture.drawn(rng, CANDIDATES), solids.drawn(rng, CANDIDATES)])
    if states is not None:
        drawn[kept, 0] = states[kept]
    objects = len(mixture.centres)
    log_offered = [mixture.log_density(drawn[:objects]), solids.log_density(drawn[objects:])]
    given = drawn, solids.is_round, np.concatenate(log_offered), log_hidden
    return drawn, candidates_of(rng, frames, priors, *given)


def presence_posterior(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    mixture: StateMixture,
    solids: SolidFits,
    chains: int,
    hidden: HiddenPlaces,
    alike: NDArray[np.bool_],
) -> Presence:
    """Presence of N objects by chains that start with the empty scene.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of sets and poses.
        mixture: of the objects, from which candidates are drawn.
        solids: unknown things that may be there in their place.
        chains: how many.
        hidden: what objects that were not found do to the likelihood out of sight.
        alike: (N, N) which objects are of one shape.
    """
    with np.errstate(divide="ignore"):
        log_hidden = np.log(hidden.share)
    objects, beside = len(mixture.centres), len(solids.is_round)
    draw = partial(drawn_candidates, rng, frames, priors, mixture, solids, log_hidden)
    nowhere = np.tile([1.0, *[0.0] * 9], (objects + beside, 1))
    runs = [chain_presence(rng, draw, nowhere) for _ in range(chains)]
    by_chain, states, in_use, visits = zip(*runs, strict=True)
    there, unseen = np.moveaxis(np.stack(by_chain)[:, :objects], 2, 0)
    told = there.mean(axis=0)
    of_share = (
        unseen.mean(axis=0) * (1 - told) * hidden.share_std / np.where(hidden.share > 0, hidden.share, 1)
    )
    of_chains = there.std(axis=0, ddof=1) / np.sqrt(chains)
    seen = (there - unseen).mean(axis=0) >= 0.5
    return Presence(
        probability=told,
        number=number_probabilities([one for run in visits for one in run], alike),
        standard_error=np.hypot(of_chains, of_share),
        seen=seen,
        poses=_in_one_scene(np.stack(states)[:, :objects, :7], np.stack(in_use)[:, :objects], seen),
    )


def _in_one_scene(
    poses: NDArray[np.float64], in_use: NDArray[np.bool_], seen: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Poses (N, 7) of the chain that agrees best with what is seen (N,), of C chains (C, N, 7).

    What it lacks is from the next best that has it.
    """
    order = np.argsort(-(in_use == seen).sum(axis=1), kind="stable")
    first = in_use[order].argmax(axis=0)
    return poses[order][first, np.arange(len(seen))]
