"""An object is where it looks most like itself, or nowhere: places where a lookalike may stand are left."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from recordings.types import DepthNoise
from scene.search.competing_scenes import rivals_of
from scene.search.hypotheses import PosePools
from scene.search.scene_edits import filled
from scene.verification.evidence import log_evidence

CONVINCING = 4.6
"""Log odds, 99 to 1, above which an object is sought nowhere else, and which it has to reach elsewhere: who
looks in many places finds something."""

PLACE, PLACES = 0.5, 3
"""Half diagonals of an object that are one place, and places where it is looked at."""


def without_lookalikes(
    pools: PosePools, scene: NDArray[np.integer], noise: DepthNoise
) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
    """The scene without objects in whose place a lookalike is more probable, and everyone's log odds (N,).

    The least probable object first, it is put elsewhere: where it stands it explains the image no better than
    a lookalike does, and so it is where it looks most like itself, or nowhere. If nobody takes its place the
    lookalike is still there: an object that was convincing beside it is so without its name, although what
    carries it seems to go on below.
    """
    settled, most = np.zeros(len(scene), bool), np.full(len(scene), np.nan)
    beside = np.full(len(scene), -np.inf)
    while True:
        odds = np.maximum(_log_odds(pools, scene, noise), beside)
        found = scene < pools.absent
        odds = np.where(found | np.isnan(most), odds, most)
        worst = int(np.argmin(np.where(found & ~settled, odds, np.inf)))
        if settled[worst] or not found[worst] or odds[worst] > CONVINCING:
            return scene, odds
        before = scene
        pools, scene, most[worst] = _looks_best(pools, scene, worst, odds[worst], noise)
        settled[worst] = True
        emptied = scene[worst] == pools.absent and (before != scene).sum() == 1
        beside = np.where(emptied & found & (scene < pools.absent) & (odds > CONVINCING), odds, -np.inf)


def convincing(pools: PosePools, scene: NDArray[np.integer], noise: DepthNoise) -> NDArray[np.bool_]:
    """Which objects (N,) of a scene look like themselves beside all others that it holds."""
    odds = _log_odds(pools, scene, noise)
    return (scene < pools.absent) & (odds > CONVINCING)


def _looks_best(
    pools: PosePools, scene: NDArray[np.integer], one: int, log_odds: float, noise: DepthNoise
) -> tuple[PosePools, NDArray[np.integer], float]:
    """Pools that leave an object one place or none, the scene with it there, and its log odds there.

    Those where the scene has it are known.
    """
    scenes, places, odds = [scene], [_place(pools, scene, one)], [log_odds]
    while len(places) < PLACES:
        elsewhere = _filled(pools.without(one, np.any(places, axis=0)), scene, one)
        if elsewhere[one] == pools.absent:
            break
        scenes.append(elsewhere)
        places.append(_place(pools, elsewhere, one))
        odds.append(float(_log_odds(pools, elsewhere, noise)[one]))
    best = int(np.argmax(odds))
    best = best if odds[best] > CONVINCING else 0
    if odds[best] >= 0:
        return pools.without(one, ~places[best]), scenes[best], odds[best]
    pools = pools.without(one, np.ones(pools.absent, bool))
    return pools, _filled(pools, scene, one), odds[best]


def _place(pools: PosePools, scene: NDArray[np.integer], one: int) -> NDArray[np.bool_]:
    """Which of an object's poses (K,) are where the scene has it."""
    centres_m = pools.poses[one, :, 4:]
    reach_m = PLACE * np.linalg.norm(pools.objects[one].half_extents_m)
    return np.linalg.norm(centres_m - centres_m[scene[one]], axis=1) < reach_m


def _filled(pools: PosePools, scene: NDArray[np.integer], one: int) -> NDArray[np.integer]:
    """The scene (N,) after an object was taken away and what gains was added, itself or others."""
    absent = np.where(np.arange(len(scene)) == one, pools.absent, scene).astype(np.int32)
    return np.asarray(filled(pools.layers, absent, np.zeros(len(scene), bool)))


def _log_odds(pools: PosePools, scene: NDArray[np.integer], noise: DepthNoise) -> NDArray[np.float64]:
    """Of every object (N,) being there against the best scene without it, or something unknown there."""
    config = pools.config
    _, by_scene = rivals_of(pools, scene)
    odds = config.pixel_weight * by_scene.astype(np.float64)
    # what is unknown had as many poses: their share counts in the scene's odds alone
    log_odds = logit(config.presence) + log_evidence(pools, scene, noise)
    return np.where(scene < pools.absent, -np.logaddexp(-odds, -log_odds), odds)
