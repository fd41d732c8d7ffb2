"""Mode jumps of the whole map after the last frame, for views far apart.

The filter may have chosen a wrong pose for lack of later keyframes. Here every keyframe is registered against
the map of all others. Those whose inlier ratio is below `CONSISTENT_INLIER_RATIO` are removed one by one and
registered again, globally, in the map of the rest, best first (`slam.map_hypotheses.cross_registration`).

It is a mode-jumping Metropolis-Hastings step (Tjelmeland and Hegland 2001): a deterministic search proposes
another mode, and the ratio of the composite likelihood of all images decides
(`KeyframeRegistrar.log_composite`). An approximation: the reverse move is not proposed, since a consistent
map starts no search.

Of few keyframes all may agree on wrong poses. Candidate maps are then proposed independently of the filter
(`slam.map_hypotheses.candidate_maps`) and all of non-negligible weight are kept.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
from numpy.typing import NDArray

from shapes.geometry.poses import matrices_of, poses_of
from slam.config import SlamConfig
from slam.filter.state import FilterState
from slam.map_hypotheses.candidate_maps import candidate_maps
from slam.map_hypotheses.cross_registration import (
    KeyframeRegistrar,
    consistent_set,
    register_inconsistent,
)
from slam.pose_graph.overlaps import KeyframeImages
from slam.pose_graph.refinement import MapMixture
from slam.pose_graph.trajectory_prior import TrajectoryPrior

SPARSE_SHARE = 0.5
"""Share of the frames that are keyframes, from which on views are far apart whatever the filter says: it may
have taken the next corner of a bare room for the last one."""

MOST_KEYFRAMES = 48
"""Search effort: the registrations grow with the square of the keyframes."""

MOST_ROUNDS = 3
"""From a first core that is small, the places of the others may be wrong again."""

SPARSE_KEYFRAMES = 12
"""Keyframes few enough to be placed without regard to what the filter found."""


def are_sparse_views(state: FilterState, frames: int, in_doubt: bool) -> bool:
    """Whether the keyframes are few, the views of a recording far apart, and their places in doubt.

    They are where a step was wide, or a frame was not found where the camera was expected, or in two places.
    """
    used = len(state.keyframe_map)
    doubtful = state.steps_were_wide or in_doubt
    return doubtful and 2 < used <= SPARSE_KEYFRAMES and used > SPARSE_SHARE * frames


def choose_map(
    key: jax.Array,
    state: FilterState,
    config: SlamConfig,
    images: KeyframeImages,
    motion: TrajectoryPrior | None,
) -> MapMixture:
    """The maps of the hypotheses, the keyframes of each placed anew where they contradict each other.

    Args:
        key: consumed.
        state: after the last frame.
        config: settings.
        images: of the keyframes.
        motion: prior of the keyframes' poses, where they are a handful.
    """
    found, used = MapMixture.of(state.population), len(state.keyframe_map)
    if not 2 < used <= MOST_KEYFRAMES or (motion is None and not state.steps_were_wide):
        return found
    registrar = KeyframeRegistrar(state.keyframe_map, state.calibration.noise, config.keyframes_compared)
    present = matrices_of(found.poses)
    if motion is not None:
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        modes = candidate_maps(registrar, list(present), motion, images, rng)
        heaviest = np.full(len(modes.shares), np.argmax(found.probabilities))
        poses = poses_of(modes.maps).astype(np.float32)
        return MapMixture(
            poses=poses,
            probabilities=modes.shares,
            hypotheses=heaviest,
            known=(None,) * len(poses),
            undiscovered=modes.undiscovered,
            unseen_step=state.unseen_step.astype(np.float64),
        )
    exponent = state.calibration.exponent
    maps = [
        _chosen(jax.random.fold_in(key, number), registrar, poses, exponent)
        for number, poses in enumerate(present)
    ]
    unknown = (None,) * len(maps)
    return replace(found, poses=poses_of(np.stack(maps)).astype(np.float32), known=unknown)


def _chosen(
    key: jax.Array, registrar: KeyframeRegistrar, poses: NDArray[np.float64], exponent: float
) -> NDArray[np.float64]:
    """Poses (N, 4, 4) after steps until all agree or one is refused."""
    core = consistent_set(registrar, poses)
    present = None
    for log_uniform in np.log(np.asarray(jax.random.uniform(key, (MOST_ROUNDS,)))):
        if len(core) == len(registrar):
            break
        proposed = register_inconsistent(registrar, poses, core)
        present = registrar.log_composite(poses) if present is None else present
        log_composite = registrar.log_composite(proposed)
        if not log_uniform < exponent * (log_composite - present):
            break
        poses, present = proposed, log_composite
        core = consistent_set(registrar, poses)
    return poses
