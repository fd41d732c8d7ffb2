"""Stage K of the supplement: a search for the most probable scene, which gives chains their start.

Rounds of search (`scene.search.search_round`) add hypotheses for what the scene leaves unexplained, and go on
for missing objects while they find any. Scenes of about equal density are refined before they are compared.
One density of the image (`scene.likelihood.pixel_density`) decides at every step. The result is a maximum and
a set of hypotheses, never samples (docs/model.md, section K).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.config import ParseConfig
from scene.execution import compile_in_background
from scene.likelihood.object_density import compile_layer_densities
from scene.likelihood.object_renderer import ObjectRenderer
from scene.likelihood.unknown_surfaces import UnknownWeights
from scene.objects.scene_object import SceneObject
from scene.observation.frame_data import SceneData
from scene.search.assignment import choose
from scene.search.competing_scenes import PAIRED, RIVALS, best_of, decided, polished_rivals, rivals_of
from scene.search.hypotheses import PosePools
from scene.search.residual import unexplained_by_others
from scene.search.scene_edits import best_scene, rivals
from scene.search.search_result import Initialisation
from scene.search.search_round import COLD, HOT, PARTICLES, SWEEPS, SearchRound, log_gains


def initialise(
    key: jax.Array,
    data: SceneData,
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    noise: DepthNoise,
    config: ParseConfig,
    learned: UnknownWeights,
) -> Initialisation:
    """Search for the scene in one frame.

    Args:
        key: random key.
        data: the frame.
        objects: what to look for.
        renderer: of the same objects.
        noise: of the sensor.
        config: settings.
        learned: how well pixels foretell each other.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    poses = config.pool * (config.rounds + 1) + 1 + RIVALS
    pools = PosePools.of(data, objects, renderer, noise, config, poses, learned)
    search_round = SearchRound.of(pools, rng)
    *keys, last_key, again_key = jax.random.split(key, config.rounds + 3)
    scene = np.full(len(objects), pools.absent)
    first = data.compact if data.compact.any() else data.foreground
    masks = dict.fromkeys(range(len(objects)), first)
    with compile_in_background(*_kernels(pools)):
        for index, round_key in enumerate(keys):
            if index:
                masks = unexplained_by_others(pools, scene, by_all=True)
            if not masks:
                break
            pools, scene = search_round(round_key, pools, scene, masks, index)
        pools, scene = compare_refined(last_key, pools, scene)
        pools, scene = search_missing(again_key, search_round, pools, scene)
    others, _ = rivals_of(pools, scene)
    found = scene < pools.absent
    return Initialisation(
        poses=pools.placed(scene).astype(np.float64),
        found=found,
        rivals=pools.placed(others.diagonal()).astype(np.float64),
        pools=pools.poses.astype(np.float64),
        log_gains=np.asarray(log_gains(pools.layers, scene), np.float64),
        log_alone=np.asarray(log_gains(pools.layers, np.full_like(scene, pools.absent)), np.float64),
        atoms=search_round.boltzmann_atoms(pools, found),
    )


def compare_refined(
    key: jax.Array, pools: PosePools, scene: NDArray[np.integer]
) -> tuple[PosePools, NDArray[np.integer]]:
    """Pools with refined poses of a scene (N,) and its closest alternatives, and the best scene."""
    last = pools.absent - 1 - RIVALS
    pools = pools.with_poses(polished_rivals(pools, scene), last)
    scene = np.where((last <= scene) & (scene < pools.absent), last, scene)
    return decided(key, pools, best_of(pools, scene), last)


def search_missing(
    key: jax.Array, search_round: SearchRound, pools: PosePools, scene: NDArray[np.integer]
) -> tuple[PosePools, NDArray[np.integer]]:
    """The scene (N,) after further rounds for what it lacks, while these find more."""
    while (scene == pools.absent).any():
        key, round_key, last_key = jax.random.split(key, 3)
        unexplained = unexplained_by_others(pools, scene)
        masks = {one: mask for one, mask in unexplained.items() if scene[one] == pools.absent}
        searched = search_round(round_key, pools, scene, masks, pools.config.rounds)
        more_pools, more = compare_refined(last_key, *searched)
        if (more < pools.absent).sum() <= (scene < pools.absent).sum():
            break
        pools, scene = more_pools, more
    return pools, scene


def _kernels(pools: PosePools) -> list[Callable[[], object]]:
    """What the search runs, to be compiled."""
    layers, scene = pools.layers, np.zeros(len(pools.objects), np.int32)
    return [
        lambda: pools.renderer.compile(pools.data.window),
        lambda: compile_layer_densities(pools.pixels.density),
        lambda: best_scene.lower(layers, scene, PAIRED).compile(),
        lambda: choose.lower(jax.random.key(0), layers, HOT, COLD, PARTICLES, SWEEPS).compile(),
        lambda: rivals.lower(layers, scene, np.eye(len(scene), dtype=bool)).compile(),
    ]
