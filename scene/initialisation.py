"""Stage K of the supplement: a search for the most probable scene, which gives chains their start.

Hypotheses come from observed points and from DBSCAN clusters of points that the scene without the object
leaves unexplained, in resting, cube and spread orientations, refined by ICP; whole scenes are annealed
over the pools; then the search is repeated on what is left unexplained. Scenes that are about as good are
refined before they are told apart. The result is a maximum and a set of hypotheses, never samples (MATH.md
section K).
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise
from scene.ahead import compiled_beside
from scene.config import ParseConfig
from scene.detection import SupportPlane, clusters
from scene.existence import best_scene, rivals
from scene.found_objects import FoundObjects
from scene.initial_scene import Initialisation
from scene.lookalikes import log_odds_against_lookalikes
from scene.observation import unprojected
from scene.orientations import cube_rotations, resting_rotations, spread_rotations
from scene.polishing import polished
from scene.pools import Pools
from scene.pose_choice import PoseLayers, choose, log_conditional, log_density_of_choice
from scene.refinement import refine
from scene.rendering import ObjectRenderer
from scene.scene_data import SceneData
from scene.scene_object import SceneObject
from scene.template_search import search
from shapes.depth_noise import with_surface_error

ORIENTATIONS, FREE_ORIENTATIONS = 416, 576
YAWS = 24
ANCHORS, CENTRES = 192, 8
ANCHOR_SPACING_M = 0.012
CLUSTER_SCALES_M = (0.01, 0.02, 0.04)
UNEXPLAINED_M = 0.012
AGREE_M, FITTING = 0.006, 0.85
"""Objects that fit what is seen of them less well explain nothing to the others: they may be wrong."""
PAIRED = 32
UNDECIDED = 60.0
"""Log odds, with the likelihood's exponent 1, that better fits may turn; greater than this are those of an
object that shows nothing."""
RIVALS = 6
"""Scenes beside the best one that get a polish before they are compared for good."""
CONVINCING = 4.6
"""Log odds, 99 to 1, above which an object is sought nowhere else, and which it has to reach elsewhere: who
looks in many places finds something."""
PLACE, PLACES = 0.5, 3
"""Half diagonals of an object that are one place, and places where it is looked at."""
HOT, COLD, SWEEPS, PARTICLES = 150.0, 2.0, 12, 8


def initialise(
    key: jax.Array,
    data: SceneData,
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    noise: DepthNoise,
    config: ParseConfig,
) -> Initialisation:
    """Search for the scene in one frame.

    Args:
        key: random key.
        data: the frame.
        objects: what to look for.
        renderer: of the same objects.
        noise: of the sensor.
        config: settings.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    searched = config.pool * (config.rounds + 1)
    pools = Pools.of(data, objects, renderer, noise, config, searched + 1 + RIVALS, rng)
    rotations = [_orientations(one, data.table) for one in objects]
    *keys, last_key = jax.random.split(key, config.rounds + 2)
    scene, masks = np.full(len(objects), pools.absent), [data.foreground] * len(objects)
    with compiled_beside(*_kernels(pools)):
        for turn, round_key in enumerate(keys):
            found = _hypotheses(data, objects, rotations, masks, rng, config.pool)
            pools = pools.with_poses(found, turn * config.pool)
            choices, log_densities = choose(round_key, pools.layers, HOT, COLD, PARTICLES, SWEEPS)
            scene = _best(pools, np.asarray(choices[jnp.argmax(log_densities)]), scene)
            masks = _unexplained_by_others(pools, scene)
    pools = pools.with_poses(_polished_rivals(pools, scene), searched)
    scene = _best(pools, scene)
    others, log_odds = _rivals(pools, scene)
    close = [one for one in _closest(log_odds)[:RIVALS] if abs(log_odds[one]) < UNDECIDED]
    if close:
        pools, scene = _decided(last_key, pools, [scene, *others[close]], searched, noise)
    scene, log_odds = _without_lookalikes(pools, scene, noise)
    return Initialisation(
        poses=pools.placed(scene).astype(np.float64),
        found=scene < pools.absent,
        log_odds=log_odds,
        pools=pools.poses.astype(np.float64),
        log_gains=np.asarray(_gains(pools.layers, scene), np.float64),
    )


def _kernels(pools: Pools) -> list[Callable[[], object]]:
    """What the search runs, to be compiled."""
    layers, scenes = pools.layers, jnp.zeros((2, len(pools.objects)), jnp.int32)
    return [
        lambda: pools.renderer.compile(pools.data.window),
        lambda: best_scene.lower(layers, scenes, PAIRED).compile(),
        lambda: choose.lower(jax.random.key(0), layers, HOT, COLD, PARTICLES, SWEEPS).compile(),
        lambda: rivals.lower(layers, scenes[0]).compile(),
    ]


def _best(pools: Pools, *scenes: NDArray[np.integer]) -> NDArray[np.int32]:
    """The best scene (N,) found from one or two, by one kernel."""
    two = np.stack([scenes[0], scenes[-1]]).astype(np.int32)
    return np.asarray(best_scene(pools.layers, jnp.asarray(two), PAIRED))


def _rivals(pools: Pools, scene: NDArray[np.integer]) -> tuple[NDArray[np.integer], NDArray[np.floating]]:
    """For every object the best scene (N, N) with or without it, and its log odds (N,)."""
    others, log_odds = rivals(pools.layers, jnp.asarray(scene))
    return np.asarray(others), np.asarray(log_odds)


def _closest(log_odds: NDArray[np.floating]) -> NDArray[np.intp]:
    """The objects (N,), those first about which the scene and its rival are about as good."""
    return np.argsort(np.abs(log_odds), kind="stable")


def _polished_rivals(pools: Pools, scene: NDArray[np.integer]) -> NDArray[np.float32]:
    """Poses (N, 1 + RIVALS, 7) polished in the scene and in those that come next, where fits are compared."""
    others, log_odds = _rivals(pools, scene)
    scenes = [scene, *others[np.resize(_closest(log_odds), RIVALS)]]
    return np.stack(
        [
            polished(pools.data, pools.objects, pools.renderer, pools.placed(one), one < pools.absent)
            for one in scenes
        ],
        axis=1,
    )


def _decided(
    key: jax.Array, pools: Pools, scenes: Sequence[NDArray[np.integer]], first: int, noise: DepthNoise
) -> tuple[Pools, NDArray[np.integer]]:
    """The best of scenes that are about as good: they are refined to tell.

    ICP looks at surfaces alone; outlines decide between objects that show the same face.

    Args:
        key: random key.
        pools: of poses.
        scenes: the best one, and at most RIVALS others.
        first: place of 1 + RIVALS poses that make room for the refined ones.
        noise: of the sensor.
    """
    noise = with_surface_error(noise, pools.config.search_error_m)
    scenes = list({one.tobytes(): one for one in scenes}.values())
    refined = np.stack([_refined(key, pools, one, noise) for one in scenes], axis=1)
    pools = pools.with_poses(refined[:, np.resize(np.arange(len(scenes)), 1 + RIVALS)], first)
    scenes = [np.where(one < pools.absent, first + place, pools.absent) for place, one in enumerate(scenes)]
    log_densities = [float(log_density_of_choice(pools.layers, jnp.asarray(one))) for one in scenes]
    best = scenes[int(np.argmax(log_densities))]
    return pools, _best(pools, best)


def _without_lookalikes(
    pools: Pools, scene: NDArray[np.integer], noise: DepthNoise
) -> tuple[NDArray[np.integer], NDArray[np.float64]]:
    """The scene without objects in whose place a lookalike is more probable, and everyone's log odds (N,).

    The least probable object first, it is put elsewhere: where it stands it explains the image no better than
    a lookalike does, and so it is where it looks most like itself, or nowhere.
    """
    noise = with_surface_error(noise, pools.config.model_error_m)
    settled, most = np.zeros(len(scene), bool), np.full(len(scene), np.nan)
    while True:
        odds = _log_odds(pools, scene, noise)
        found = scene < pools.absent
        odds = np.where(found | np.isnan(most), odds, most)
        worst = int(np.argmin(np.where(found & ~settled, odds, np.inf)))
        if settled[worst] or not found[worst] or odds[worst] > CONVINCING:
            return scene, odds
        pools, scene, most[worst] = _looks_best(pools, scene, worst, noise)
        settled[worst] = True


def _looks_best(
    pools: Pools, scene: NDArray[np.integer], one: int, noise: DepthNoise
) -> tuple[Pools, NDArray[np.integer], float]:
    """Pools that leave an object one place or none, the scene with it there, and its log odds there."""
    reach_m = PLACE * np.linalg.norm(pools.objects[one].half_extents_m)
    centres_m = pools.poses[one, :, 4:]
    free, places, odds, scenes = np.ones(pools.absent, bool), [], [], [scene]
    while scenes[-1][one] < pools.absent and len(places) < PLACES:
        odds.append(float(_log_odds(pools, scenes[-1], noise)[one]))
        places.append(np.linalg.norm(centres_m - centres_m[scenes[-1][one]], axis=1) < reach_m)
        free &= ~places[-1]
        elsewhere = np.where(np.arange(len(scene)) == one, pools.absent, scene)
        scenes.append(_best(pools.without(one, ~free), elsewhere))
    best = int(np.argmax(odds))
    best = best if odds[best] > CONVINCING else 0
    if odds[best] >= 0:
        return pools.without(one, ~places[best]), scenes[best], odds[best]
    pools = pools.without(one, np.ones(pools.absent, bool))
    return pools, _best(pools, np.where(np.arange(len(scene)) == one, pools.absent, scene)), odds[best]


def _log_odds(pools: Pools, scene: NDArray[np.integer], noise: DepthNoise) -> NDArray[np.float64]:
    """Of every object (N,) being there against the best scene without it, or a lookalike in its place."""
    config = pools.config
    _, by_scene = _rivals(pools, scene)
    odds = config.pixel_weight * by_scene.astype(np.float64)
    by_look = log_odds_against_lookalikes(
        pools.data, noise, pools.shown(scene), config.presence, config.pixel_weight
    )
    return np.where(scene < pools.absent, -np.logaddexp(-odds, -by_look), odds)


def _refined(
    key: jax.Array, pools: Pools, scene: NDArray[np.integer], noise: DepthNoise
) -> NDArray[np.float32]:
    """Poses (N, 7) of a scene, those of what is there refined."""
    found = FoundObjects.of(scene < pools.absent)
    poses = pools.placed(scene)
    start = Initialisation(
        poses=found.poses(poses),
        found=found.present,
        log_odds=np.zeros(found.slots),
        pools=np.zeros((found.slots, 0, 7)),
        log_gains=np.zeros((found.slots, 1)),
    )
    weight = pools.config.pixel_weight
    refined = refine(key, pools.data, pools.renderer, found.placed, start, noise, weight)
    poses[found.indices] = refined.means[: len(found.indices), 0]
    return poses


def _orientations(one: SceneObject, table: SupportPlane | None) -> NDArray[np.float32]:
    """Camera_from_box rotations (O, 3, 3): resting, the cube's 24, and an even spread."""
    if table is None:
        return spread_rotations(FREE_ORIENTATIONS).astype(np.float32)
    fixed = np.concatenate([resting_rotations(one.rests, YAWS), cube_rotations()])
    fixed = table.camera_from_table[:3, :3] @ fixed
    return np.concatenate([fixed, spread_rotations(ORIENTATIONS - len(fixed))]).astype(np.float32)


def _hypotheses(
    data: SceneData,
    objects: Sequence[SceneObject],
    rotations: Sequence[NDArray[np.float32]],
    masks: Sequence[NDArray[np.bool_]],
    rng: np.random.Generator,
    pool: int,
) -> NDArray[np.float32]:
    """Poses (N, pool, 7) of every object on the pixels of its mask, searched side by side on all cores."""
    places = [_places(data, mask, rng) for mask in masks]

    def find(index: int) -> NDArray[np.float32]:
        one, view = objects[index], replace(data.view, unexplained=masks[index])
        return np.asarray(search(view, one.points_m, one.normals, rotations[index], *places[index], pool)[0])

    with ThreadPoolExecutor(os.cpu_count()) as cores:
        return np.stack(list(cores.map(find, range(len(objects)))))


def _places(
    data: SceneData, mask: NDArray[np.bool_], rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Anchors (ANCHORS, 3) spread over the masked points, and cluster centres (CENTRES, 3)."""
    points = unprojected(np.asarray(data.view.depth_m), data.view.camera).astype(np.float32)
    masked = points[mask] if mask.sum() >= 10 else points[data.foreground]
    masked = masked[rng.permutation(len(masked))]
    _, first = np.unique(np.floor(masked / ANCHOR_SPACING_M).astype(int), axis=0, return_index=True)
    anchors = masked[rng.permutation(first)]
    centres = clusters(anchors, CLUSTER_SCALES_M, fewest=3)
    centres = np.concatenate([centres, masked.mean(axis=0)[None]])
    return np.resize(anchors, (ANCHORS, 3)).astype(np.float32), np.resize(centres, (CENTRES, 3)).astype(
        np.float32
    )


def _unexplained_by_others(pools: Pools, scene: NDArray[np.integer]) -> list[NDArray[np.bool_]]:
    """For every object the view's foreground that a scene leaves unexplained without it."""
    shown_m = pools.shown(scene)
    shown_m[_fit(pools.data, shown_m) < FITTING] = np.inf
    return [_unexplained(pools.data, np.delete(shown_m, one, axis=0)) for one in range(len(scene))]


def _fit(data: SceneData, shown_m: NDArray[np.float32]) -> NDArray[np.float64]:
    """The share (N,) of what each layer (N, H, W) shows in the scene that agrees with the measurements."""
    observed_m = data.window.depth_m
    front_m = np.minimum(shown_m.min(axis=0), data.rest_m)
    seen = np.isfinite(shown_m) & (shown_m <= front_m) & (observed_m != NO_RETURN)
    agree = seen & (np.abs(shown_m - observed_m) < AGREE_M)
    return agree.sum(axis=(1, 2)) / np.maximum(seen.sum(axis=(1, 2)), 1)


def _unexplained(data: SceneData, others_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The view's foreground that other objects, layers (N - 1, H, W) of the window, leave unexplained.

    What they show in a neighbouring pixel of the window explains a pixel too.
    """
    view, camera = data.view, data.window.camera
    rows, columns = np.nonzero(data.foreground)
    observed_m = np.asarray(view.depth_m)[rows, columns]
    u = (columns - float(view.camera.cx)) / float(view.camera.fx) * float(camera.fx) + float(camera.cx)
    v = (rows - float(view.camera.cy)) / float(view.camera.fy) * float(camera.fy) + float(camera.cy)
    front_m = np.pad(others_m.min(axis=0, initial=np.inf), 1, constant_values=np.inf)
    height, width = data.rest_m.shape
    u, v = np.clip(np.rint(u).astype(int), 0, width - 1), np.clip(np.rint(v).astype(int), 0, height - 1)
    gap_m = np.full(len(rows), np.inf)
    for down, across in itertools.product(range(3), repeat=2):
        gap_m = np.minimum(gap_m, np.abs(front_m[v + down, u + across] - observed_m))
    mask = np.zeros_like(data.foreground)
    mask[rows, columns] = gap_m >= UNEXPLAINED_M
    return mask


@jax.jit
def _gains(layers: PoseLayers, chosen: jax.Array) -> jax.Array:
    conditionals = jax.vmap(lambda index: log_conditional(layers, chosen, index))(jnp.arange(len(chosen)))
    return conditionals - conditionals[jnp.arange(len(chosen)), chosen][:, None]
