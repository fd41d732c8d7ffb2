"""Pose hypotheses for the next frame: near each particle group's prediction, or anywhere in the map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from shapes.geometry import pose_gaussian
from shapes.geometry.pose_sets import cluster, mean_and_covariance, turns_wide
from shapes.geometry.poses import matrices_of, single_precision_poses
from slam.config import SlamConfig
from slam.filter import smc
from slam.filter.motion import LONGEST_RATIO, velocity_ratio
from slam.filter.state import CameraParticles, FilterState
from slam.keyframes.depth_view import CanvasView, central_depth
from slam.registration import pose_grids
from slam.registration.registered import Registration, prune_improbable, suppress_duplicates
from slam.registration.search import GroupMap, Searcher


@dataclass(frozen=True)
class Prediction:
    """What K particles expect.

    Attributes:
        poses: (K, 7) reference_from_camera, the last motion going on.
        groups: (K,) of particles that are in one place.
        weights: (K,) of the particles, normalised.
        trusted: whether it is worth keeping where depth tells nothing.
    """

    poses: jax.Array
    groups: NDArray[np.int_]
    weights: NDArray[np.float64]
    trusted: bool


def predict(state: FilterState, time_ns: int) -> Prediction:
    """Of the frame with that stamp."""
    particles: CameraParticles = state.population.particles
    ratio = velocity_ratio(state.times_ns, time_ns)
    weights = np.exp(np.asarray(state.population.log_weights, np.float64))
    return Prediction(
        poses=_carried_on(particles, ratio),
        groups=cluster(matrices_of(particles.pose), weights),
        weights=weights,
        trusted=0.0 < ratio < LONGEST_RATIO and not state.was_lost,
    )


@jax.jit
def _carried_on(particles: CameraParticles, ratio: float) -> jax.Array:
    def one(previous: jax.Array, pose: jax.Array) -> jax.Array:
        return pose_gaussian.displace(pose, ratio * pose_gaussian.coordinates(previous, pose))

    return jax.vmap(one)(particles.previous_pose, particles.pose)


PREDICTION_WEIGHT = 0.01
"""`PixelTerms.held_step`'s hold at a trusted prediction."""

MAX_HYPOTHESES = 8
"""Optima that become components of one proposal."""

_mean = jax.jit(mean_and_covariance)


def find_pose_hypotheses(
    state: FilterState,
    view: CanvasView,
    prediction: Prediction,
    config: SlamConfig,
    odometry: NDArray[np.float64] | None,
) -> tuple[list[Registration], bool]:
    """Optima worth proposing, the best first, and whether none was found where the camera was expected.

    A single one of group -1 stands for a lost camera.

    Where depth tells nothing of a direction, as along a bare wall, a trusted prediction is kept.

    Each group of particles looks near its own prediction. Where none finds a convincing place, or the
    camera was lost and predictions mean little, all look where it was last found, and everywhere; after
    a wide step already where none finds an unmistakable one.
    """
    searcher = Searcher(state.keyframe_map, view, state.calibration.noise, config.keyframes_compared)
    found = _near_predictions(searcher, state, prediction, config, odometry)
    convincing = [located for located in found if located.is_accepted]
    doubtful = not any(located.is_unambiguous for located in found)
    unexpected = not convincing
    if unexpected or (doubtful and _step_may_be_wide(state.population)):
        everyone = _group_map(state, prediction.weights, 0)
        distances = np.asarray(pose_grids.ORBIT_DISTANCES) * central_depth(view)
        found.append(searcher.near(everyone, [state.last_found]))
        found += searcher.anywhere(everyone, state.last_found, distances)
        convincing = [replace(located, group=0) for located in suppress_duplicates(found)]
    kept = prune_improbable(convincing, state.calibration.exponent)
    kept.sort(key=lambda located: -float(located.optimum.log_density))
    return kept[:MAX_HYPOTHESES] or [replace(found[0], group=-1)], unexpected


def _near_predictions(
    searcher: Searcher,
    state: FilterState,
    prediction: Prediction,
    config: SlamConfig,
    odometry: NDArray[np.float64] | None,
) -> list[Registration]:
    """The best optimum near each group's prediction; none after a frame that was lost."""
    particles: CameraParticles = state.population.particles
    found = []
    hold = PREDICTION_WEIGHT if prediction.trusted else 0.0
    for group in range(0 if state.was_lost else prediction.groups.max() + 1):
        group_map = _group_map(state, np.where(prediction.groups == group, prediction.weights, 0.0), group)
        last = _mean(particles.pose, group_map.weights)[0]
        starts = [] if odometry is None else [single_precision_poses(matrices_of(last) @ odometry)]
        if config.proposal != "kiss" or odometry is None:
            starts = [_mean(prediction.poses, group_map.weights)[0], last, *starts]
        found.append(searcher.near(group_map, starts, hold if len(starts) > 1 else 0.0))
    return found


def _step_may_be_wide(population: smc.Population) -> bool:
    """Whether the next step may lead to a place that only looks like it: the last one turned far.

    Round an object on a pedestal the last view explains most of the next one, a fifth of a circle on. Of the
    first step nothing is known.
    """
    before, after = last_motion(population)
    return bool(np.array_equal(before, after)) or turns_wide(before, after)


def last_motion(population: smc.Population) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (4, 4) of the heaviest particle, in the frame before the last and in the last."""
    particles: CameraParticles = population.particles
    heaviest = int(jnp.argmax(population.log_weights))
    return matrices_of(particles.previous_pose[heaviest]), matrices_of(particles.pose[heaviest])


def _group_map(state: FilterState, weights: NDArray[np.float64], group: int) -> GroupMap:
    share = jnp.asarray(weights / weights.sum(), jnp.float32)
    heaviest = matrices_of(state.keyframe_poses[int(np.argmax(weights))])
    return GroupMap(state.keyframe_poses, share, heaviest, group)
