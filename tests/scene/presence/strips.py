"""A world of strips: step-shaped objects at whole places of a row of pixels, with something unknown about."""

import numpy as np

from scene.model.number_prior import NumberPrior
from scene.presence.forests import ForestPrior
from scene.presence.posterior import Ensemble
from scene.presence.toggling import Candidates, SlotLayers

WIDTH, PLACES, BACKGROUND_M, SIGMA_M = 24, 20, 1.0, 0.15

STEPS_M = np.array([[0.6, 0.6, 0.75, 0.75, np.inf], [0.55, 0.85, 0.85, 0.55, 0.55]])
"""Two step-shaped objects, depth over pixels from their place on."""

UNKNOWN, ABOUT_M, REACH_M = 0.2, 0.1, 2.0
"""Share of pixels that show something unknown: half of it near the pixel before, half anywhere."""


def layer_m(kind: int, place: int) -> np.ndarray:
    """Depth (WIDTH,) of one object alone."""
    depth_m = np.full(WIDTH + STEPS_M.shape[1], np.inf)
    depth_m[place : place + STEPS_M.shape[1]] = STEPS_M[kind]
    return depth_m[:WIDTH].astype(np.float32)


def depth_m(kinds: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Depth (WIDTH,) of a scene; a place of -1 is none."""
    layers = [layer_m(kind, place) for kind, place in zip(kinds, places, strict=True) if place >= 0]
    return np.min([np.full(WIDTH, BACKGROUND_M), *layers], axis=0)


def log_density(observed_m: np.ndarray, shown_m: np.ndarray) -> np.ndarray:
    """Log density (..., WIDTH) of pixels that show a depth (..., WIDTH)."""
    before = np.concatenate([[BACKGROUND_M], observed_m[:-1]])
    unknown = 0.5 * _normal(observed_m, before, ABOUT_M) + 0.5 * (np.abs(observed_m) < REACH_M) / (
        2 * REACH_M
    )
    return np.log((1 - UNKNOWN) * _normal(observed_m, shown_m, SIGMA_M) + UNKNOWN * unknown)


def observed(rng: np.random.Generator, shown_m: np.ndarray) -> np.ndarray:
    """A draw (WIDTH,) of that density."""
    seen, before = [], BACKGROUND_M
    for depth in shown_m:
        scene, about = rng.normal(depth, SIGMA_M), rng.normal(before, ABOUT_M)
        unknown = about if rng.random() < 0.5 else rng.uniform(-REACH_M, REACH_M)
        before = unknown if rng.random() < UNKNOWN else scene
        seen.append(before)
    return np.array(seen)


def _normal(value: np.ndarray, mean: np.ndarray, sigma: float) -> np.ndarray:
    return np.exp(-0.5 * ((value - mean) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))


def drawn_ensemble(
    rng: np.random.Generator,
    observed_m: np.ndarray,
    kinds: np.ndarray,
    number: NumberPrior,
    count: int,
    before: Ensemble | None,
    slots: np.ndarray,
) -> Ensemble:
    """Places (N, count) of some slots (N,) drawn evenly, those of the others and the scene as before."""
    places = rng.integers(PLACES, size=(len(kinds), count))
    if before is not None:
        places = np.where(slots[:, None], places, before.states)
        kept = before.in_use & slots
        places[kept, 0] = before.chosen[kept]
    candidates = candidates_at(observed_m, kinds, number, places)
    return Ensemble.of(places, np.zeros_like(places), candidates, before, slots)


def candidates_at(
    observed_m: np.ndarray, kinds: np.ndarray, number: NumberPrior, places: np.ndarray
) -> Candidates:
    """Candidates at places (N, count), of the even draw of which every one is as likely."""
    slots, count = places.shape
    empty = log_density(observed_m, np.full(WIDTH, BACKGROUND_M))
    layers = []
    for kind, mine in zip(kinds, places, strict=True):
        shown = np.stack([layer_m(kind, place) for place in mine])
        shown = np.where(shown < BACKGROUND_M, shown, np.float32(np.inf))
        gain = log_density(observed_m, np.where(np.isfinite(shown), shown, BACKGROUND_M)) - empty
        gain = np.where(np.isfinite(shown), gain, 0.0)
        layers.append(SlotLayers(np.arange(WIDTH), shown, gain.astype(np.float32)))
    return Candidates(
        layers,
        np.full(places.shape, -np.log(PLACES)),
        ForestPrior(
            on_root=np.full(places.shape, 1 / PLACES),
            weights_beside=lambda *_: np.zeros((2, slots, count)),
            log_trees=np.zeros(slots + 1),
            log_sets=number.log_set_probabilities(slots),
            asked=slots,
        ),
        np.full(slots, -np.inf),
    )


def all_scenes(slots: int) -> np.ndarray:
    """Places (S, slots) of all scenes, -1 for none."""
    axes = [np.arange(-1, PLACES)] * slots
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, slots)


def exact_presence(observed_m: np.ndarray, kinds: np.ndarray, number: NumberPrior) -> np.ndarray:
    """Presence (N,) by the sum over all scenes."""
    there, shares = _scene_shares(observed_m, kinds, number)
    return shares @ there


def exact_numbers(observed_m: np.ndarray, kinds: np.ndarray, number: NumberPrior) -> np.ndarray:
    """Probabilities (N + 1,) that so many are there, by the same sum."""
    there, shares = _scene_shares(observed_m, kinds, number)
    return np.bincount(there.sum(axis=1), shares, minlength=len(kinds) + 1)


def _scene_shares(
    observed_m: np.ndarray, kinds: np.ndarray, number: NumberPrior
) -> tuple[np.ndarray, np.ndarray]:
    """Which slots are there (S, N) in every scene, and its probability (S,)."""
    scenes = all_scenes(len(kinds))
    there = scenes >= 0
    log_prior = number.log_set_probabilities(len(kinds))[there.sum(axis=1)]
    shown = np.stack([depth_m(kinds, places) for places in scenes])
    log_weights = log_prior - there.sum(axis=1) * np.log(PLACES) + log_density(observed_m, shown).sum(axis=1)
    weights = np.exp(log_weights - log_weights.max())
    return there, weights / weights.sum()
