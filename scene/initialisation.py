"""Stage K of the supplement: a search for the most probable scene, which gives chains their start.

Hypotheses come from observed points and from DBSCAN clusters of points that the scene without the object
leaves unexplained, in resting, cube and spread orientations, refined by ICP; whole scenes are annealed
over the pools; then the search is repeated on what is left unexplained. The result is a maximum and a
set of hypotheses, never samples (MATH.md section K).
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise
from scene.ahead import compiled_beside
from scene.burial import log_not_buried
from scene.compared_pixels import ComparedPixels
from scene.detection import SupportPlane, clusters
from scene.existence import best_scene, rivals
from scene.observation import unprojected
from scene.orientations import cube_rotations, resting_rotations, spread_rotations
from scene.polishing import polished
from scene.pose_choice import PoseLayers, choose, log_conditional
from scene.rendering import OUT_OF_SIGHT, ObjectRenderer
from scene.scene_data import SceneData
from scene.scene_object import SceneObject
from scene.template_search import search

ORIENTATIONS, FREE_ORIENTATIONS = 416, 576
YAWS = 24
ANCHORS, CENTRES = 192, 8
ANCHOR_SPACING_M = 0.012
CLUSTER_SCALES_M = (0.01, 0.02, 0.04)
UNEXPLAINED_M = 0.012
AGREE_M, FITTING = 0.006, 0.85
"""Objects that fit what is seen of them less well explain nothing to the others: they may be wrong."""
PAIRED = 32
RIVALS = 6
"""Scenes beside the best one that get a polish before they are compared for good."""
HOT, COLD, SWEEPS, PARTICLES = 150.0, 2.0, 12, 8


@dataclass(frozen=True, kw_only=True, eq=False)
class Initialisation:
    """The best scene found and the pools that it was chosen from.

    Attributes:
        poses: (N, 7) camera_from_box, wxyz_xyz; meaningless where not found.
        found: (N,) bool.
        log_odds: (N,) of each object being there against not, with the likelihood's exponent 1.
        pools: (N, K, 7).
        log_gains: (N, K) log density of the scene with each pose of the pool in place of the best one,
            less that of the best scene; the last column is without the object.
    """

    poses: NDArray[np.float64]
    found: NDArray[np.bool_]
    log_odds: NDArray[np.float64]
    pools: NDArray[np.float64]
    log_gains: NDArray[np.float64]


def initialise(
    key: jax.Array,
    data: SceneData,
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    noise: DepthNoise,
    surface_sigma_m: float,
    *,
    sunk_sigma_m: float,
    log_odds: float,
    pixel_weight: float,
    rounds: int,
    pool: int,
) -> Initialisation:
    """Search for the scene.

    Args:
        key: random key.
        data: one frame.
        objects: what to look for.
        renderer: of the same objects.
        noise: of the sensor.
        surface_sigma_m: error of surfaces, of shapes and of poses in the pool together.
        sunk_sigma_m: by which an object may reach below the table.
        log_odds: of an object in one pose against its absence.
        pixel_weight: the likelihood's exponent.
        rounds: of renewed search on what is left unexplained.
        pool: poses an object and round.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    pixels = ComparedPixels.of(data, noise, surface_sigma_m, log_odds / pixel_weight, rng)
    rotations = [_orientations(one, data.table) for one in objects]
    unexplained = [data.foreground] * len(objects)
    searched = pool * (rounds + 1)
    everywhere = searched + 1 + RIVALS
    pools = np.tile(np.asarray(OUT_OF_SIGHT, np.float32), (len(objects), everywhere, 1))
    layers = pixels.no_layers(len(objects), everywhere)
    chosen = np.full(len(objects), everywhere)
    starts = jnp.zeros((2, len(objects)), jnp.int32)

    def put(found: NDArray[np.float32], first: int) -> PoseLayers:
        pools[:, first : first + found.shape[1]] = found
        drawn = renderer.layers(
            np.repeat(np.arange(len(objects)), found.shape[1]), found.reshape(-1, 7), data.window
        )
        log_prior = log_not_buried(data.table, objects, found, sunk_sigma_m) / pixel_weight
        return pixels.with_layers(layers, drawn, log_prior, first)

    keys = jax.random.split(key, rounds + 1)
    with compiled_beside(
        lambda: renderer.compile(data.window),
        lambda: best_scene.lower(layers, starts, PAIRED).compile(),
        lambda: choose.lower(keys[0], layers, HOT, COLD, PARTICLES, SWEEPS).compile(),
        lambda: rivals.lower(layers, starts[0]).compile(),
    ):
        for turn, round_key in enumerate(keys):
            found = _hypotheses(data, objects, rotations, unexplained, rng, pool)
            layers = put(found, turn * pool)
            choices, log_densities = choose(round_key, layers, HOT, COLD, PARTICLES, SWEEPS)
            starts = jnp.stack([choices[jnp.argmax(log_densities)], jnp.asarray(chosen)])
            chosen = np.asarray(best_scene(layers, starts, PAIRED))
            shown = _shown(renderer, data, pools, chosen)
            shown[_fit(data, shown) < FITTING] = np.inf
            unexplained = [_unexplained(data, np.delete(shown, one, axis=0)) for one in range(len(objects))]
    layers = put(_polished_rivals(data, objects, renderer, layers, pools, chosen), searched)
    starts = jnp.asarray(np.stack([chosen, chosen]))  # two as before, for one kernel
    chosen = np.asarray(best_scene(layers, starts, PAIRED))
    _, log_odds = rivals(layers, jnp.asarray(chosen))
    return Initialisation(
        poses=_placed(pools, chosen).astype(np.float64),
        found=chosen < everywhere,
        log_odds=np.asarray(log_odds, np.float64),
        pools=pools.astype(np.float64),
        log_gains=np.asarray(_gains(layers, chosen), np.float64),
    )


def _polished_rivals(
    data: SceneData,
    objects: Sequence[SceneObject],
    renderer: ObjectRenderer,
    layers: PoseLayers,
    pools: NDArray[np.float32],
    chosen: NDArray[np.int64],
) -> NDArray[np.float32]:
    """Poses (N, 1 + RIVALS, 7) polished in the scene and in those that come next, where fits are compared."""
    scenes, log_odds = rivals(layers, jnp.asarray(chosen))
    closest = np.argsort(np.abs(np.asarray(log_odds)), kind="stable")
    scenes = [chosen, *np.asarray(scenes)[np.resize(closest, RIVALS)]]
    return np.stack(
        [
            polished(data, objects, renderer, _placed(pools, scene), scene < pools.shape[1])
            for scene in scenes
        ],
        axis=1,
    )


def _placed(pools: NDArray[np.float32], chosen: NDArray[np.int64]) -> NDArray[np.float32]:
    """The chosen poses (N, 7), of the absent ones any."""
    return pools[np.arange(len(pools)), np.minimum(chosen, pools.shape[1] - 1)]


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


def _shown(
    renderer: ObjectRenderer, data: SceneData, pools: NDArray[np.float32], chosen: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Depth (N, H, W) of every object's chosen pose alone in the window, +inf for absent ones."""
    count, poses = pools.shape[:2]
    depth = renderer.layers(np.arange(count), _placed(pools, chosen), data.window)
    return np.where((chosen < poses)[:, None, None], depth, np.float32(np.inf))


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
