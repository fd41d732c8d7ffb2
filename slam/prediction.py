"""What the particles expect of the next frame, before it is looked at."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray

from shapes.poses import matrices_of
from slam import pose_gaussian
from slam.filter_state import FilterState
from slam.particles import CameraParticles, grouped

LONGEST_RATIO = 3.0


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


def predicted(state: FilterState, time_ns: int) -> Prediction:
    """Of the frame with that stamp."""
    particles: CameraParticles = state.population.particles
    ratio = velocity_ratio(state.times_ns, time_ns)
    weights = np.exp(np.asarray(state.population.log_weights, np.float64))
    return Prediction(
        poses=_carried_on(particles, ratio),
        groups=grouped(matrices_of(particles.pose), weights),
        weights=weights,
        trusted=0.0 < ratio < LONGEST_RATIO and not state.was_lost,
    )


def velocity_ratio(times_ns: tuple[int, int], time_ns: int) -> float:
    """The coming interval in units of the last one; zero where there is none, at most `LONGEST_RATIO`."""
    last = times_ns[1] - times_ns[0]
    return float(np.clip((time_ns - times_ns[1]) / last, 0.0, LONGEST_RATIO)) if last > 0 else 0.0


@jax.jit
def _carried_on(particles: CameraParticles, ratio: float) -> jax.Array:
    def one(previous: jax.Array, pose: jax.Array) -> jax.Array:
        return pose_gaussian.displaced(pose, ratio * pose_gaussian.coordinates(previous, pose))

    return jax.vmap(one)(particles.previous_pose, particles.pose)
