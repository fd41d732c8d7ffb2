"""Unknown solids of a scene: Gaussians round those that explain it best together, of all proposed ones."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scene.observation.frame_data import SceneData
from scene.presence.births import fit_gaussians
from scene.presence.depth_candidates import PresenceFrames, gain_before, nearest_shown
from scene.presence.gaussian_fits import climbed
from scene.presence.pose_priors import LEAST_DENSITY, PosePriors
from scene.presence.solid_proposals import boxes_in_place, proposed_solids
from scene.presence.solids import (
    FREE_OF_CYLINDERS,
    GREATEST_M,
    LEAST_M,
    SolidFits,
    log_sizes_density,
    solid_half_sizes,
    tied,
)
from scene.presence.state_mixture import StateMixture

MOST_SOLIDS = 12
"""Unknown solids that are looked for in a frame: more things of that kind on one table are rare."""

FIRST_STEPS = np.repeat([0.006, 0.06], [6, 3])
"""Of faces (metres) and turns (radians): proposals are fitted to points, good to a pixel at a metre."""

FIRST_CLIMBS, CLIMBS = 2, 8
"""Turns of climbing before solids are chosen, and after it. A proposal explains little where it stands: it is
a centimetre off, and its sides hide what is measured behind them."""


def competing_solids(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    views: Mapping[int, SceneData],
    mixture: StateMixture,
) -> SolidFits:
    """Gaussians round unknown solids that may be there beside objects, or in their place.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of poses.
        views: of the frames, by number, with the foreground in which solids are looked for.
        mixture: of the objects.
    """
    proposed = [proposed_solids(view, frames.compared.world_from(number)) for number, view in views.items()]
    boxes = boxes_in_place(mixture)
    proposed.append((boxes, np.zeros(len(boxes), bool)))
    starts, is_round = (np.concatenate(part) for part in zip(*proposed, strict=True))
    return solids_near(rng, frames, priors, starts, is_round, MOST_SOLIDS * len(views))


def solids_near(
    rng: np.random.Generator,
    frames: PresenceFrames,
    priors: PosePriors,
    starts: NDArray[np.float64],
    is_round: NDArray[np.bool_],
    most: int,
) -> SolidFits:
    """Gaussians round unknown solids, the densest of those that are proposed.

    Args:
        rng: random numbers.
        frames: what is seen.
        priors: of poses.
        starts: (n, 10) world_from_solid and logs of half sizes.
        is_round: (n,) which are cylinders.
        most: solids at most.
    """
    if not len(starts):
        return SolidFits.none()
    starts = np.array(starts)
    starts[:, 7:] = np.clip(starts[:, 7:], np.log(LEAST_M), np.log(GREATEST_M))
    near = climbed(partial(_log_alone, frames, priors, is_round), starts, FIRST_STEPS, FIRST_CLIMBS)
    chosen = _densest_together(frames, priors, tied(near, is_round), is_round, most)
    if not len(chosen):
        return SolidFits.none()
    is_round = is_round[chosen]
    log_density = partial(_log_alone, frames, priors, is_round)
    best = climbed(log_density, near[chosen], FIRST_STEPS, CLIMBS)
    fits = fit_gaussians(rng, log_density, best, ~is_round[:, None] | FREE_OF_CYLINDERS.astype(bool))
    return SolidFits(is_round=is_round, centres=tied(fits.centres, is_round), factors=fits.factors)


def _densest_together(
    frames: PresenceFrames,
    priors: PosePriors,
    states: NDArray[np.float64],
    is_round: NDArray[np.bool_],
    most: int,
) -> list[int]:
    """Of solids (n, 10) those that one after the other raise the density of the scene most, while they do."""
    depth_m, gain = frames.shown_solids(states, is_round)
    log_prior = _log_prior(priors, states[:, None], is_round)[:, 0]
    front = np.full_like(depth_m[0], np.inf), np.zeros_like(gain[0])
    chosen: list[int] = []
    while len(chosen) < min(most, len(states)):
        worth = gain_before((depth_m, gain), front) + log_prior
        worth[chosen] = -np.inf
        best = int(worth.argmax())
        if worth[best] <= 0:
            break
        chosen.append(best)
        both = (np.stack([one, other[best]]) for one, other in zip(front, (depth_m, gain), strict=True))
        front = nearest_shown(*both)
    return chosen


def _log_alone(
    frames: PresenceFrames, priors: PosePriors, is_round: NDArray[np.bool_], states: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Log density (n, S) of solids (n, S, 10), alone in the scene."""
    states = tied(states, is_round)
    _, gain = frames.shown_solids(states.reshape(-1, 10), np.repeat(is_round, states.shape[1]))
    log_likelihood = gain.sum(axis=1, dtype=np.float64).reshape(states.shape[:2])
    return log_likelihood + _log_prior(priors, states, is_round)


def _log_prior(
    priors: PosePriors, states: NDArray[np.float64], is_round: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Log prior (n, S) of poses and sizes of solids (n, S, 10), finite everywhere."""
    log_poses = priors.log_alone(states[..., :7], solid_half_sizes(states))
    log_sizes = log_sizes_density(states[..., 7:], is_round[:, None])
    return log_poses + np.maximum(log_sizes, np.log(LEAST_DENSITY))
