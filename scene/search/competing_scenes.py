"""Scenes that are about as good, refined before they are told apart."""

from __future__ import annotations

import jax
import numpy as np
from numpy.typing import NDArray

from scene.copies import copies_among
from scene.execution import map_parallel
from scene.objects.slots import FoundObjects
from scene.search.assignment import log_density_of_choice
from scene.search.hypotheses import PosePools
from scene.search.importance_sampling import refine
from scene.search.rendered_icp import refine_in_render
from scene.search.scene_edits import best_scene, rivals
from shapes.depth_noise import with_surface_error

_log_density = jax.jit(log_density_of_choice)

PAIRED = 32
"""Poses of two objects that are compared jointly."""

UNDECIDED = 60.0
"""Log odds, with the likelihood's exponent 1, that better fits may turn; greater than this are those of an
object that shows nothing."""

RIVALS = 6
"""Scenes beside the best one that get a polish before they are compared for good."""


def best_of(pools: PosePools, *scenes: NDArray[np.integer]) -> NDArray[np.int32]:
    """The best scene (N,) found from some, each on a core of its own."""

    def better(one: NDArray[np.integer]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        return jax.device_get(best_scene(pools.layers, one.astype(np.int32), PAIRED))

    found, log_densities = zip(*map_parallel(better, scenes), strict=True)
    return found[int(np.argmax(log_densities))]


def rivals_of(
    pools: PosePools, scene: NDArray[np.integer]
) -> tuple[NDArray[np.integer], NDArray[np.floating]]:
    """For every object the best scene (N, N) with or without it, and its log odds (N,)."""
    alike = copies_among({one.name: one.points_m for one in pools.objects})
    others, log_odds = rivals(pools.layers, scene, alike)
    return np.asarray(others), np.asarray(log_odds)


def polished_rivals(pools: PosePools, scene: NDArray[np.integer]) -> NDArray[np.float32]:
    """Poses (N, 1 + RIVALS, 7) polished in the scene and in those that come next, where fits are compared."""
    others, log_odds = rivals_of(pools, scene)
    scenes = [scene, *others[np.resize(_closest(log_odds), RIVALS)]]

    def better(one: NDArray[np.integer]) -> NDArray[np.float32]:
        return refine_in_render(
            pools.data, pools.objects, pools.renderer, pools.placed(one), one < pools.absent
        )

    return np.stack(map_parallel(better, scenes), axis=1)


def decided(
    key: jax.Array, pools: PosePools, scene: NDArray[np.integer], first: int
) -> tuple[PosePools, NDArray[np.integer]]:
    """The best of a scene and those that are about as good: they are refined to tell.

    ICP looks at surfaces alone; outlines decide between objects that show the same face.

    Args:
        key: random key.
        pools: of poses.
        scene: (N,) the best one.
        first: place of 1 + RIVALS poses that make room for the refined ones.
    """
    others, log_odds = rivals_of(pools, scene)
    close = [one for one in _closest(log_odds)[:RIVALS] if abs(log_odds[one]) < UNDECIDED]
    if not close:
        return pools, scene
    scenes = list({one.tobytes(): one for one in [scene, *others[close]]}.values())
    refined = [_refined(key, pools, scene, pools.placed(scene), scene < pools.absent)]
    for one in scenes[1:]:  # where it differs from the best scene, whose own are refined
        differs = one != scene
        poses = np.where(differs[:, None], pools.placed(one), refined[0])
        refined.append(_refined(key, pools, one, poses, differs & (one < pools.absent)))
    places = np.resize(np.arange(len(scenes)), 1 + RIVALS)
    pools = pools.with_poses(np.stack(refined, axis=1)[:, places], first)
    scenes = [np.where(one < pools.absent, first + place, pools.absent) for place, one in enumerate(scenes)]
    log_densities = [float(_log_density(pools.layers, one)) for one in scenes]
    best = scenes[int(np.argmax(log_densities))]
    return pools, best_of(pools, best)


def _refined(
    key: jax.Array,
    pools: PosePools,
    scene: NDArray[np.integer],
    poses: NDArray[np.float32],
    moving: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Poses (N, 7) of what a scene holds, those of the `moving` ones refined from given ones."""
    if not moving.any():
        return poses
    found = FoundObjects.of(scene < pools.absent)
    noise = with_surface_error(pools.noise, pools.config.search_error_m)
    moves = found.present & moving[found.placed]
    refined = refine(
        key, pools.data, pools.renderer, found.placed, found.poses(poses), found.present, moves, noise
    )
    poses = poses.copy()
    poses[found.indices] = refined[: len(found.indices)]
    return poses


def _closest(log_odds: NDArray[np.floating]) -> NDArray[np.intp]:
    """The objects (N,), those first about which the scene and its rival are about as good."""
    return np.argsort(np.abs(log_odds), kind="stable")
