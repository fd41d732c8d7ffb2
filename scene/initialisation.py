"""Stage K of the supplement: a search for the most probable scene, which gives chains their start.

Hypotheses come from observed points and from DBSCAN clusters of points that the scene without the object
leaves unexplained, in resting, cube and spread orientations, refined by ICP; whole scenes are annealed
over the pools; then the search is repeated on what is left unexplained. Scenes that are about as good are
refined before they are told apart. Where lookalikes were taken out, what stood behind their names is sought
once more. The result is a maximum and a set of hypotheses, never samples (MATH.md section K).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.ahead import compiled_beside
from scene.config import ParseConfig
from scene.cores import side_by_side
from scene.detection import SupportPlane, clusters
from scene.existence import best_scene, rivals
from scene.gaps import Settled, told, without_gaps
from scene.initial_scene import Initialisation
from scene.observation import unprojected
from scene.orientations import cube_rotations, resting_rotations, spread_rotations
from scene.pools import Pools
from scene.pose_choice import PoseLayers, choose, log_conditional
from scene.rendering import ObjectRenderer
from scene.rival_scenes import PAIRED, RIVALS, best_of
from scene.scene_data import SceneData
from scene.scene_object import SceneObject
from scene.template_search import search
from scene.unexplained import unexplained_by_others

ORIENTATIONS, FREE_ORIENTATIONS = 416, 576
YAWS = 24
ANCHORS, CENTRES = 192, 8
ANCHOR_SPACING_M = 0.012
CLUSTER_SCALES_M = (0.01, 0.02, 0.04)
FEWEST_PIXELS = 10
"""Of a mask; else an object is sought on the whole foreground."""
HOT, COLD, SWEEPS = 150.0, 2.0, 12
PARTICLES, GROUPS = 4, 2
"""Annealed together, and how many groups of them."""


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
    poses = config.pool * (config.rounds + 1) + 1 + RIVALS
    pools = Pools.of(data, objects, renderer, noise, config, poses, rng)
    seek = partial(_sought, rng, [_orientations(one, data.table) for one in objects])
    *keys, last_key, again_key = jax.random.split(key, config.rounds + 3)
    scene = np.full(len(objects), pools.absent)
    masks = dict.fromkeys(range(len(objects)), data.foreground)
    with compiled_beside(*_kernels(pools)):
        for turn, round_key in enumerate(keys):
            pools, scene = seek(round_key, pools, scene, masks, turn)
            masks = unexplained_by_others(pools, scene)
    settled = Settled.of(*told(last_key, pools, scene, noise), noise)
    settled = without_gaps(again_key, seek, settled, noise)
    pools, scene = settled.pools, settled.scene
    return Initialisation(
        poses=pools.placed(scene).astype(np.float64),
        found=scene < pools.absent,
        log_odds=settled.log_odds,
        pools=pools.poses.astype(np.float64),
        log_gains=np.asarray(_gains(pools.layers, scene), np.float64),
    )


def _kernels(pools: Pools) -> list[Callable[[], object]]:
    """What the search runs, to be compiled."""
    layers, scene = pools.layers, np.zeros(len(pools.objects), np.int32)
    return [
        lambda: pools.renderer.compile(pools.data.window),
        lambda: best_scene.lower(layers, scene, PAIRED).compile(),
        lambda: choose.lower(jax.random.key(0), layers, HOT, COLD, PARTICLES, SWEEPS).compile(),
        lambda: rivals.lower(layers, scene).compile(),
    ]


def _orientations(one: SceneObject, table: SupportPlane | None) -> NDArray[np.float32]:
    """Camera_from_box rotations (O, 3, 3): resting, the cube's 24, and an even spread."""
    if table is None:
        return spread_rotations(FREE_ORIENTATIONS).astype(np.float32)
    fixed = np.concatenate([resting_rotations(one.rests, YAWS), cube_rotations()])
    fixed = table.camera_from_table[:3, :3] @ fixed
    return np.concatenate([fixed, spread_rotations(ORIENTATIONS - len(fixed))]).astype(np.float32)


def _sought(
    rng: np.random.Generator,
    rotations: Sequence[NDArray[np.float32]],
    key: jax.Array,
    pools: Pools,
    scene: NDArray[np.integer],
    masks: Mapping[int, NDArray[np.bool_]],
    turn: int,
) -> tuple[Pools, NDArray[np.int32]]:
    """`scene.gaps.Seek`, with the orientations of every object."""
    size = pools.config.pool
    poses = pools.poses[:, turn * size : (turn + 1) * size].copy()
    poses[list(masks)] = _hypotheses(pools, rotations, masks, rng)
    pools = pools.with_poses(poses, turn * size)
    return pools, best_of(pools, _annealed(key, pools.layers), scene)


def _annealed(key: jax.Array, layers: PoseLayers) -> NDArray[np.int32]:
    """The best scene (N,) of all particles, groups of which are annealed side by side."""

    def anneal(key: jax.Array) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        return jax.device_get(choose(key, layers, HOT, COLD, PARTICLES, SWEEPS))

    groups = side_by_side(anneal, jax.random.split(key, GROUPS))
    choices, log_densities = (np.concatenate(leaves) for leaves in zip(*groups, strict=True))
    return choices[np.argmax(log_densities)]


def _hypotheses(
    pools: Pools,
    rotations: Sequence[NDArray[np.float32]],
    masks: Mapping[int, NDArray[np.bool_]],
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """Poses (M, pool, 7) of objects on the pixels of M masks, searched side by side on all cores."""
    data, size = pools.data, pools.config.pool
    points = unprojected(np.asarray(data.view.depth_m), data.view.camera).astype(np.float32)
    enough = {one: mask if mask.sum() >= FEWEST_PIXELS else data.foreground for one, mask in masks.items()}
    drawn = {one: _drawn(points[mask], rng) for one, mask in enough.items()}

    def find(index: int) -> NDArray[np.float32]:
        one, view = pools.objects[index], replace(data.view, unexplained=masks[index])
        places = _places(*drawn[index])
        return np.asarray(search(view, one.points_m, one.normals, rotations[index], *places, size)[0])

    return np.stack(side_by_side(find, masks))


def _drawn(
    points_m: NDArray[np.float32], rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The points (M, 3) in random order, and as random ones (A, 3) spread over them."""
    points_m = points_m[rng.permutation(len(points_m))]
    return points_m, points_m[rng.permutation(_one_a_cell(points_m))]


def _places(
    points_m: NDArray[np.float32], anchors_m: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Anchors (ANCHORS, 3) and centres (CENTRES, 3) of their clusters and of all the points they are from."""
    centres = clusters(anchors_m, CLUSTER_SCALES_M, fewest=3)
    centres = np.concatenate([centres, points_m.mean(axis=0)[None]])
    return np.resize(anchors_m, (ANCHORS, 3)), np.resize(centres, (CENTRES, 3)).astype(np.float32)


def _one_a_cell(points_m: NDArray[np.float32]) -> NDArray[np.intp]:
    """Places of the first of the points (N, 3) in each cell of ANCHOR_SPACING_M."""
    cells = np.floor(points_m / ANCHOR_SPACING_M).astype(np.int64)
    cells -= cells.min(axis=0)
    return np.unique(np.ravel_multi_index(tuple(cells.T), cells.max(axis=0) + 1), return_index=True)[1]


@jax.jit
def _gains(layers: PoseLayers, chosen: jax.Array) -> jax.Array:
    conditionals = jax.vmap(lambda index: log_conditional(layers, chosen, index))(jnp.arange(len(chosen)))
    return conditionals - conditionals[jnp.arange(len(chosen)), chosen][:, None]
