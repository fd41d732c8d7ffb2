"""Keyframes that contradict each other are placed anew, once all of them are known.

With views far apart the filter may have to choose between places of which none of the earlier keyframes can
tell; later ones could, but by then its particles agree on a wrong place, or on two clusters of views that are
right in themselves and wrong to each other. Here every keyframe is compared with all the others. Where some
contradict (what is seen should lie on the map wherever the map is met), those that contradict most are left
out until the rest is of one mind, and are then sought anywhere in the map of the rest, the surest first. Of a
handful, none may stand right: they are placed without regard to their order first (`slam.surest_first`).

It is a mode-jumping Metropolis-Hastings step (Tjelmeland and Hegland 2001): a deterministic search proposes
another mode, particles keep their displacements from the mean, so that volumes stay, and the ratio of the
composite likelihood of all images decides (`Jury.log_composite`). An approximation: the way back is not
proposed, for from the better mode nothing contradicts and no search begins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from numpy.typing import NDArray

from shapes.poses import matrices_of
from slam.config import SlamConfig
from slam.filter_state import FilterState
from slam.jury import Jury, agreement
from slam.particles import CameraParticles, grouped, mean_keyframes
from slam.rigid import single_precision_poses
from slam.surest_first import placed_surest_first

WIDE_STEP_RAD = 0.4
"""From frame to frame: with narrower steps the filter does not lose its way."""
MOST_KEYFRAMES = 48
AGREEING = 0.9
"""Share of the returns that meet the map and lie on it, from which on a keyframe does not contradict: at true
poses round objects it was .92 at least, at wrong ones .6 to .9 (development films, seeds 0 and 101)."""
LEAST_CORE = 2
MOST_ROUNDS = 3
"""From a first core that is small, the places of the others may be wrong again."""
HANDFUL = 12
"""Keyframes few enough to be placed without regard to their order."""

Search = Callable[[NDArray[np.float64], list[int]], NDArray[np.float64] | None]
"""Other poses (N, 4, 4) for keyframes of which some agree, or None where there is nothing to propose."""


def reconsidered(key: jax.Array, state: FilterState, config: SlamConfig) -> FilterState:
    """The state with the keyframes of every mode placed anew where they contradict each other.

    Args:
        key: consumed.
        state: after the last frame.
        config: settings.
    """
    particles: CameraParticles = state.population.particles
    used = len(state.keyframe_map)
    poses = particles.keyframe_poses[:, :used]
    weights = np.exp(np.asarray(state.population.log_weights, np.float64))
    if not 2 < used <= MOST_KEYFRAMES or not state.steps_were_wide:
        return state
    modes = grouped(matrices_of(poses), weights)
    jury = Jury(state.keyframe_map, state.calibration.noise, config.keyframes_compared)
    surest_first = cache(lambda: placed_surest_first(jury))
    searches: list[Search] = [partial(placed_anew, jury)] * MOST_ROUNDS
    if used <= HANDFUL:
        searches.insert(0, lambda poses, core: surest_first())  # noqa: ARG005
    for mode in range(modes.max() + 1):
        members = modes == mode
        mean = mean_keyframes(poses, jnp.asarray(np.where(members, weights, 0.0) / weights[members].sum()))
        mode_key, exponent = jax.random.fold_in(key, mode), state.calibration.exponent
        chosen = _chosen(mode_key, jury, searches, matrices_of(mean), exponent)
        if chosen is not None:
            moved = carried(poses, mean, single_precision_poses(chosen))
            poses = jnp.where(jnp.asarray(members)[:, None, None], moved, poses)
    keyframe_poses = particles.keyframe_poses.at[:, :used].set(poses)
    population = replace(state.population, particles=replace(particles, keyframe_poses=keyframe_poses))
    return replace(state, population=population)


def _chosen(
    key: jax.Array, jury: Jury, searches: list[Search], poses: NDArray[np.float64], exponent: float
) -> NDArray[np.float64] | None:
    """Poses (N, 4, 4) after a step by each search until all agree; None where none was taken."""
    core = agreeing(jury, poses)
    present, refused, accepted = None, None, False
    for search, log_uniform in zip(
        searches, np.log(np.asarray(jax.random.uniform(key, (len(searches),)))), strict=True
    ):
        if len(core) == len(jury) or search is refused:
            break
        proposed = search(poses, core)
        if proposed is None:
            continue
        present = jury.log_composite(poses) if present is None else present
        log_composite = jury.log_composite(proposed)
        if log_uniform < exponent * (log_composite - present):
            poses, present, accepted = proposed, log_composite, True
            core = agreeing(jury, poses)
        else:
            refused = search
    return poses if accepted else None


def is_wide(before: NDArray[np.float64], after: NDArray[np.float64]) -> bool:
    """Whether a step from a pose (4, 4) to another turns far."""
    return bool(0.5 * (np.trace(before[:3, :3].T @ after[:3, :3]) - 1.0) < np.cos(WIDE_STEP_RAD))


@jax.jit
def carried(poses: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
    """Poses (K, N, 7) that keep their displacements when their means (N, 7) move."""

    def one(pose: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
        return (jaxlie.SE3(after) @ jaxlie.SE3(before).inverse() @ jaxlie.SE3(pose)).wxyz_xyz

    return jax.vmap(jax.vmap(one), (0, None, None))(poses, before, after)


def placed_anew(jury: Jury, poses: NDArray[np.float64], core: list[int]) -> NDArray[np.float64]:
    """Poses (N, 4, 4) with those that are not of the `core` sought in its map."""
    poses = poses.copy()
    missing = [index for index in range(len(jury)) if index not in core]
    while missing:
        found = {index: next(iter(jury.sought(poses, index, core)), None) for index in missing}
        sure = [index for index in missing if (place := found[index]) and agreement(place) >= AGREEING]
        most = max(missing, key=lambda index: place.explained if (place := found[index]) else -1.0)
        for index in sure or [most]:
            if place := found[index]:
                poses[index] = matrices_of(place.optimum.pose)
            core, missing = sorted([*core, index]), [other for other in missing if other != index]
    return np.linalg.inv(poses[0]) @ poses


def agreeing(jury: Jury, poses: NDArray[np.float64]) -> list[int]:
    """Keyframes that do not contradict each other: those that do most are left out, one by one."""
    core = list(range(len(jury)))
    while len(core) > LEAST_CORE:
        agreements = [
            agreement(jury.located(poses, index, [other for other in core if other != index]))
            for index in core
        ]
        worst = int(np.argmin(agreements))
        if agreements[worst] >= AGREEING:
            break
        del core[worst]
    return core
