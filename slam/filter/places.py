"""A place where a frame may have been taken: a Gaussian there, and the evidence for it (Laplace).

Keyframes may be found later to stand elsewhere. To first order the place is then shifted by
H^-1 sum_i H_i e_i, where e_i is the displacement of keyframe i and H_i the part of the curvature that
the pixels of keyframe i contribute (`Place.shares`).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from shapes.geometry import pose_gaussian
from slam.filter.motion import MotionHistory, MotionPrior
from slam.registration.local_map import LocalMap
from slam.registration.local_search import Optimum


@dataclass(frozen=True)
class Place:
    """The posterior about a local optimum of the image density, in one hypothesis.

    Attributes:
        pose: (7,) reference_from_camera, its mean.
        covariance: (6, 6) in the chart there.
        shares: (M, 6, 6) H^-1 H_i, how it follows each keyframe that it was compared with.
        keyframes_from_camera: (M, 7).
        log_evidence: log of the integral of p(image | x)^exponent p(x | past) about it.
    """

    pose: NDArray[np.float32]
    covariance: NDArray[np.float64]
    shares: NDArray[np.float64]
    keyframes_from_camera: NDArray[np.float32]
    log_evidence: float


def place_at(
    optimum: Optimum, local_map: LocalMap, past: MotionHistory, motion: MotionPrior, exponent: float
) -> Place:
    """Laplace's approximation at an optimum of the image density, which is tempered by `exponent`.

    The prior moves the optimum by its Gauss-Newton terms, and what the image loses on the way there counts.
    In double precision: what pixels hold most and least of a pose without noise differ by more than single
    precision has digits.
    """
    jacobian, offset = (np.asarray(term, np.float64) for term in _prior_terms(optimum.pose, past, motion))
    of_keyframes = exponent * np.asarray(optimum.layer_precisions, np.float64)
    seen, axes = np.linalg.eigh(of_keyframes.sum(axis=0))
    of_image = (axes * np.maximum(seen, 0.0)) @ axes.T
    precision = of_image + jacobian.T @ jacobian
    covariance = np.linalg.inv(precision)
    covariance = 0.5 * (covariance + covariance.T)
    shift = -covariance @ jacobian.T @ offset
    pose = _displaced(optimum.pose, shift.astype(np.float32))
    log_image = exponent * float(optimum.log_density) - 0.5 * shift @ of_image @ shift
    log_prior = float(_log_prior(pose, past, motion))
    log_volume = 3.0 * np.log(2.0 * np.pi) - 0.5 * np.linalg.slogdet(precision)[1] - pose_gaussian.LOG_8
    return Place(
        pose=np.asarray(pose),
        covariance=covariance,
        shares=covariance @ of_keyframes,
        keyframes_from_camera=np.asarray(local_map.keyframes_from_camera(pose)),
        log_evidence=float(log_image + log_prior + log_volume),
    )


@jax.jit
def _prior_terms(pose: jax.Array, past: MotionHistory, motion: MotionPrior) -> tuple[jax.Array, jax.Array]:
    """Jacobian (R, 6) of the residual of a pose (7,) in the chart there, and that (R,)."""

    def residual(xi: jax.Array) -> jax.Array:
        return motion.whitened_residual(past, pose_gaussian.displace(pose, xi))

    zero = jnp.zeros(6, jnp.float32)
    return jax.jacfwd(residual)(zero), residual(zero)


@jax.jit
def _log_prior(pose: jax.Array, past: MotionHistory, motion: MotionPrior) -> jax.Array:
    return motion.log_density(past, pose)


_displaced = jax.jit(pose_gaussian.displace)
