"""Two motions in one frame: what moves before the camera, or along with it, against the room.

A frame is compared with one earlier view of the same camera. Blocks of its pixels belong to one of two rigid
motions: a mixture, fitted by EM. Where it explains the frame better than one motion does, by the Bayesian
information criterion, two things move against each other, and geometry does not say which is the room.

Either motion has the density of the image in the map (`slam.likelihood.image_density`), that view being all
of the map. The odds count those pixels alone of which one motion says what they must show: what comes out of
hiding is open, and that another motion would explain it (a can looks the same from all sides, as if it went
along with a camera that goes round it) speaks for no motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from recordings.types import DepthNoise
from shapes.geometry import pose_gaussian
from shapes.stored_kernels import jit_stored
from slam.keyframes.depth_view import CanvasView
from slam.keyframes.surfels import SurfelImage
from slam.likelihood.noise_calibration import EXPONENT_RANGE
from slam.registration.alignment import STIFFNESS, PixelTerms
from slam.registration.view_comparison import BLOCKS, ViewComparison

INFLATIONS = (8.0, 4.0, 2.0, 1.0, 1.0)
"""Of sigma, from iteration to iteration."""

PRIOR_LOG_ODDS = -24.0
"""That something moves against the room. Half a nat for each of 48 blocks: by so much their densities are off
on 24 short walks (docs/model.md, development films). Blocks that together contradict the first motion by less
cannot pay for a second one."""

PARAMETERS = 7
"""A second motion adds a pose and a share."""

LEAST_SHARE = 0.02
"""Of blocks, one in 48: what is less is no motion."""

DECISIVE = 3.0
"""Nats by which a block must prefer a motion to count for it, 20 to 1: along a wall motions look alike."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TwoMotions:
    """A frame as two rigid motions.

    Attributes:
        poses: (2, 7) reference_from_camera by either.
        covariances: (2, 6, 6) of these, in their charts, from the spread of the blocks' scores.
        shares: (2,) of the returns, that each alone explains.
        explained: share of the returns that either explains.
        log_odds: of two motions against one.
    """

    poses: jax.Array
    covariances: jax.Array
    shares: jax.Array
    explained: jax.Array
    log_odds: jax.Array


def _moved(pose: jax.Array, terms: PixelTerms, belongs: jax.Array) -> jax.Array:
    """A Gauss-Newton step of a pose (7,) on blocks that belong to it with probabilities (B,)."""
    weight = terms.weight * (BLOCKS @ belongs)
    precision = (terms.jacobian * weight[None]) @ terms.jacobian.T
    gradient = terms.jacobian @ (weight * terms.residual)
    step = jnp.linalg.solve(precision + STIFFNESS * jnp.eye(6, dtype=pose.dtype), gradient)
    return pose_gaussian.displace(pose, step)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Pairs:
    """Pairs of motions (n, 2) to which EM led, blocks being independent.

    Attributes:
        poses: (n, 2, 7).
        covariances: (n, 2, 6, 6) of these.
        shares: (n, 2) of the blocks, that belong to either.
        belongs: (n, 2, B) with which probabilities they do.
        inlier: (n, 2, P) probability that a pixel lies on either's surface.
        exponent: (n,) tempering of pixels as the scores of the blocks ask for, each with its own motion.
            Where something moves, the one that the filter learns from all blocks as one is far too small.
    """

    poses: jax.Array
    covariances: jax.Array
    shares: jax.Array
    belongs: jax.Array
    inlier: jax.Array
    exponent: jax.Array


def two_motions(
    reference: SurfelImage, view: CanvasView, noise: DepthNoise, first: jax.Array, second: jax.Array
) -> TwoMotions | None:
    """The pair of motions that explains a frame best, of those to which EM leads from two starts.

    Beside `second` this is where those blocks lead that fit `first` worst.

    Args:
        reference: an earlier view, in its camera's frame.
        view: the frame.
        noise: the sensor.
        first: (7,) reference_from_camera, where the frame was found.
        second: (7,) where else it may be.

    Returns:
        None where so little contradicts the first motion that there is nothing to find.
    """
    compared = ViewComparison(reference, view, noise)
    here = _log_factors(compared, first[None])
    if float(_contradiction(here[0][0])) < -PRIOR_LOG_ODDS:
        return None
    optima, pairs = _fitted(compared, first, second, here[0][0])
    there = _log_factors(compared, jnp.concatenate([optima, pairs.poses.reshape(-1, 7)]))
    return _weighed(compared, here, there, pairs)


@jax.jit
def explained_share(
    reference: SurfelImage, view: CanvasView, noise: DepthNoise, pose: jax.Array
) -> jax.Array:
    """Share of a frame's returns that lie on an earlier view's surface, the frame being at a pose (7,)."""
    compared = ViewComparison(reference, view, noise)
    terms, _ = compared.terms(pose, 1.0)
    return terms.inlier.sum() / jnp.maximum(compared.returned().sum(), 1)


@jit_stored()
def _log_factors(compared: ViewComparison, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`ViewComparison.log_factors` at poses (n, 7): in a kernel of its own each takes thrice as long."""
    return jax.lax.map(compared.log_factors, poses)


@jax.jit
def _contradiction(log_factors: jax.Array) -> jax.Array:
    """By how much all blocks of pixels (P,) together are less probable than were nothing known of them."""
    return -jnp.minimum(log_factors @ BLOCKS, 0.0).sum()


@jit_stored()
def _fitted(
    compared: ViewComparison, first: jax.Array, second: jax.Array, log_factors: jax.Array
) -> tuple[jax.Array, _Pairs]:
    """The optima (2, 7) of one motion near both starts, and the pairs of `two_motions`.

    `log_factors` (P,) are those of `first`.
    """
    count = compared.returned().astype(jnp.float32) @ BLOCKS
    fit = jnp.where(count > 0, log_factors @ BLOCKS / jnp.maximum(count, 1.0), jnp.inf)
    worst = (fit <= jnp.median(fit)).astype(jnp.float32)
    led = _moved_on(compared, first, worst, INFLATIONS[:3])
    everything = jnp.ones_like(worst)
    optima = jax.vmap(lambda start: _moved_on(compared, start, everything, INFLATIONS))(
        jnp.stack([first, second])
    )
    return optima, jax.vmap(partial(_pair, compared, first))(jnp.stack([second, led]))


def _moved_on(
    compared: ViewComparison, start: jax.Array, belongs: jax.Array, inflations: tuple[float, ...]
) -> jax.Array:
    """Where blocks of these weights (B,) lead from a pose (7,)."""

    def further(pose: jax.Array, inflation: jax.Array) -> tuple[jax.Array, None]:
        return _moved(pose, compared.terms(pose, inflation)[0], belongs), None

    return jax.lax.scan(further, start, jnp.asarray(inflations, start.dtype))[0]


def _pair(compared: ViewComparison, first: jax.Array, second: jax.Array) -> _Pairs:
    """EM from two poses (7,)."""

    def assigned(poses: jax.Array, shares: jax.Array) -> tuple[PixelTerms, jax.Array]:
        terms, log_blocks = jax.vmap(partial(compared.terms, inflation=1.0))(poses)
        return terms, jax.nn.softmax(jnp.log(shares)[:, None] + log_blocks, axis=0)

    def iteration(
        state: tuple[jax.Array, jax.Array], inflation: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], None]:
        poses, shares = state
        _, belongs = assigned(poses, shares)
        terms, _ = jax.vmap(partial(compared.terms, inflation=inflation))(poses)
        shares = jnp.clip(belongs.mean(axis=1), LEAST_SHARE, 1.0 - LEAST_SHARE)
        return (jax.vmap(_moved)(poses, terms, belongs), shares), None

    start = (jnp.stack([first, second]), jnp.full(2, 0.5, first.dtype))
    (poses, shares), _ = jax.lax.scan(iteration, start, jnp.asarray(INFLATIONS, first.dtype))
    terms, belongs = assigned(poses, shares)
    covariances, inflations = jax.vmap(_covariance)(terms, belongs)
    exponent = jnp.clip(1.0 / (belongs.mean(axis=1) @ inflations), *EXPONENT_RANGE)
    return _Pairs(poses, covariances, shares, belongs, terms.inlier, exponent)


@jax.jit
def _weighed(
    compared: ViewComparison,
    here: tuple[jax.Array, jax.Array],
    there: tuple[jax.Array, jax.Array],
    pairs: _Pairs,
) -> TwoMotions:
    """The best pair, against the best single motion, on the pixels of which that says anything.

    Args:
        compared: the frame.
        here: log factors (1, P) of where it was found and which pixels that shows.
        there: the same (6, P) of the other single motions, two, and of both motions of every pair.
        pairs: these.
    """
    factors, shown = (jnp.concatenate([one, other[:2]]) for one, other in zip(here, there, strict=True))
    log_ones = jnp.where(jnp.isfinite(factors).all(axis=1), factors.sum(axis=1), -jnp.inf)
    best = jnp.argmax(log_ones)
    log_blocks = jnp.where(shown[best], there[0][2:], 0.0) @ BLOCKS
    log_blocks = pairs.exponent[:, None, None] * log_blocks.reshape(*pairs.poses.shape[:2], -1)
    log_two = jax.nn.logsumexp(jnp.log(pairs.shares)[:, :, None] + log_blocks, axis=1).sum(axis=1)
    count = jnp.maximum(compared.returned().sum(), 1)
    penalty = 0.5 * PARAMETERS * jnp.log(jnp.maximum(pairs.exponent * count, 1.0))
    log_odds = PRIOR_LOG_ODDS + log_two - pairs.exponent * log_ones[best] - penalty
    log_odds = jnp.where(jnp.isfinite(log_odds), log_odds, -jnp.inf)
    own = (log_blocks - log_blocks[:, ::-1] > DECISIVE).astype(jnp.float32)
    own_shares = (pairs.inlier * (own @ BLOCKS.T)).sum(axis=2) / count
    explained = (pairs.inlier * (pairs.belongs @ BLOCKS.T)).sum(axis=(1, 2)) / count
    best = jnp.argmax(log_odds)
    return TwoMotions(
        pairs.poses[best], pairs.covariances[best], own_shares[best], explained[best], log_odds[best]
    )


def _covariance(terms: PixelTerms, belongs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of a pose (6, 6), blocks being independent, H^-1 V H^-1, and trace(H^-1 V) / 6 (`NoiseCalibration`)."""
    weight = BLOCKS @ belongs
    precision = (terms.jacobian * (terms.weight * weight)[None]) @ terms.jacobian.T
    scores = (terms.scores() * weight[None]) @ BLOCKS
    inverse = jnp.linalg.inv(precision + STIFFNESS * jnp.eye(6, dtype=precision.dtype))
    spread = inverse @ (scores @ scores.T)
    return spread @ inverse, jnp.trace(spread) / 6.0
