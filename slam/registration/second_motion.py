"""Two motions in one frame: what moves before the camera, or along with it, against the room.

A frame is compared with one earlier view of the same camera. Blocks of its pixels belong to one of two rigid
motions: a mixture, fitted by EM. Where it explains the frame better than one motion does, by the Bayesian
information criterion, two things move against each other, and geometry does not say which is the room.

What the view did not see is as probable as its neighbours make it (`slam.likelihood.unmapped_depth`):
surfaces that come out of hiding are no motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from recordings.types import NO_RETURN, DepthNoise
from shapes.geometry import pose_gaussian
from slam.keyframes.depth_view import CANVAS_HEIGHT, CANVAS_WIDTH, CanvasView
from slam.likelihood.image_density import STRIDE_PX
from slam.likelihood.noise_calibration import EXPONENT_RANGE
from slam.likelihood.unmapped_depth import log_density_of_unknown, predict_from_neighbours
from slam.registration.alignment import STIFFNESS, ModelImage, PixelTerms, associate, pixel_terms

COMPARED_STRIDE_PX = 4
"""Search effort: one pixel in 16."""

BLOCK_SIDE_PX = 20
"""Side of the blocks that move as one: as those whose scores count as independent
(`slam.registration.local_search.BLOCK_SIDE`)."""

INFLATIONS = (8.0, 4.0, 2.0, 1.0, 1.0)
"""Of sigma, from iteration to iteration."""

ASSIGNING_EXPONENT = 0.4
"""Tempering while blocks are assigned: what the filter begins with (`NoiseCalibration.initial`), on a quarter
of its pixels."""

PRIOR_LOG_ODDS = -24.0
"""That something moves against the room. Half a nat for each of 48 blocks: by so much their densities are off
where surfaces come out of hiding, on 24 short walks (docs/model.md, development films)."""

PARAMETERS = 7
"""A second motion adds a pose and a share."""

ALL_EXPLAINED = 0.985
"""Share of what the earlier view covers that the first motion explains where no other is looked for."""

LEAST_SHARE = 0.02
"""Of blocks, one in 48: what is less is no motion."""


NEW = 0.5
"""Probability that a pixel within the earlier view shows what that did not: open."""

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


@dataclass(frozen=True)
class _Comparison:
    """A frame against the reference, at any pose."""

    reference: ModelImage
    view: CanvasView
    noise: DepthNoise
    log_unknown: jax.Array

    @classmethod
    def of(cls, reference: ModelImage, view: CanvasView, noise: DepthNoise) -> _Comparison:
        lattice = view.depth_m[::STRIDE_PX, ::STRIDE_PX]
        every = COMPARED_STRIDE_PX // STRIDE_PX
        log_unknown = log_density_of_unknown(lattice, predict_from_neighbours(lattice, noise), noise)
        return cls(reference, view, noise, log_unknown[::every, ::every].ravel())

    def log_blocks(self, terms: PixelTerms) -> jax.Array:
        """Log densities (B,) of the blocks over that of everything being new, not tempered."""
        noise, eps = self.noise, float(jnp.finfo(jnp.float32).eps)
        inlier = jnp.clip(terms.inlier, eps**4, 1.0 - eps)
        outlier = noise.outlier_probability / noise.max_range_m
        log_surface = (
            jnp.log(inlier) - jnp.log1p(-inlier) + jnp.log(outlier) - jnp.log1p(-noise.outlier_probability)
        )
        log_known = jnp.log1p(-NEW) + log_surface - self.log_unknown
        log_factor = jnp.logaddexp(log_known, jnp.log(NEW))
        return jnp.where(self.returned & _in_view(terms), log_factor, 0.0) @ BLOCKS

    def terms(self, pose: jax.Array, inflation: jax.Array | float) -> tuple[PixelTerms, jax.Array]:
        """Of pixels at a pose (7,), and tempered log densities (B,) of the blocks over that of outliers."""
        planes, variance, observed, rays = associate(self.reference, self.view, pose, COMPARED_STRIDE_PX)
        terms = pixel_terms(planes, variance, observed, rays, pose, self.noise, inflation)
        log_ratio = -jnp.log1p(-jnp.minimum(terms.inlier, 1.0 - jnp.finfo(jnp.float32).eps))
        return terms, ASSIGNING_EXPONENT * (log_ratio @ BLOCKS)

    @property
    def returned(self) -> jax.Array:
        """Which of the compared pixels (P,) have a depth."""
        return self.view.depth_m[::COMPARED_STRIDE_PX, ::COMPARED_STRIDE_PX].ravel() > NO_RETURN


def _in_view(terms: PixelTerms) -> jax.Array:
    """Which of the pixels (P,) fall on a surface of the reference."""
    return (terms.jacobian != 0.0).any(axis=0)


def _moved(pose: jax.Array, terms: PixelTerms, belongs: jax.Array) -> jax.Array:
    """A Gauss-Newton step of a pose (7,) on blocks that belong to it with probabilities (B,)."""
    weight = terms.weight * (BLOCKS @ belongs)
    precision = (terms.jacobian * weight[None]) @ terms.jacobian.T
    gradient = terms.jacobian @ (weight * terms.residual)
    step = jnp.linalg.solve(precision + STIFFNESS * jnp.eye(6, dtype=pose.dtype), gradient)
    return pose_gaussian.displace(pose, step)


def _block_membership() -> np.ndarray:
    """Which block each pixel of the lattice is in, one-hot (P, B)."""
    rows, columns = (np.arange(0, size, COMPARED_STRIDE_PX) for size in (CANVAS_HEIGHT, CANVAS_WIDTH))
    block = rows[:, None] // BLOCK_SIDE_PX * (CANVAS_WIDTH // BLOCK_SIDE_PX) + columns // BLOCK_SIDE_PX
    return np.eye(block.max() + 1, dtype=np.float32)[block.ravel()]


BLOCKS = _block_membership()
"""Which block each compared pixel is in, one-hot (P, B)."""


@jax.jit
def two_motions(
    reference: ModelImage,
    view: CanvasView,
    noise: DepthNoise,
    first: jax.Array,
    second: jax.Array,
) -> TwoMotions:
    """The pair of motions that explains a frame best, of those to which EM leads from two starts.

    Beside `second` this is where those blocks lead that fit `first` worst. Where the first motion explains
    the frame there is nothing to find.

    Args:
        reference: an earlier view, in its camera's frame.
        view: the frame.
        noise: the sensor.
        first: (7,) reference_from_camera, where the frame was found.
        second: (7,) where else it may be.
    """
    compared = _Comparison.of(reference, view, noise)
    terms, log_blocks = compared.terms(first, 1.0)
    explained = terms.inlier.sum() / jnp.maximum((_in_view(terms) & compared.returned).sum(), 1)

    def search() -> TwoMotions:
        seconds = jnp.stack([second, _led_by_the_worst(compared, first, log_blocks)])
        log_one = jax.vmap(partial(_one_motion, compared))(jnp.stack([first, second])).max()
        log_odds, pairs = jax.vmap(partial(_pair, compared, log_one, first))(seconds)
        log_odds = jnp.where(jnp.isfinite(log_odds), log_odds, -jnp.inf)
        best = jnp.argmax(log_odds)
        poses, covariances, shares, either = (leaf[best] for leaf in pairs)
        return TwoMotions(poses, covariances, shares, either, log_odds[best])

    def none() -> TwoMotions:
        pose = jnp.stack([first, first])
        never = jnp.asarray(-jnp.inf, first.dtype)
        return TwoMotions(
            pose, jnp.zeros((2, 6, 6), first.dtype), jnp.zeros(2, first.dtype), explained, never
        )

    return jax.lax.cond(explained > ALL_EXPLAINED, none, search)


def _led_by_the_worst(compared: _Comparison, first: jax.Array, log_blocks: jax.Array) -> jax.Array:
    """The pose (7,) to which the half of the blocks (B,) that fits `first` worst leads from there."""
    count = compared.returned.astype(jnp.float32) @ BLOCKS
    fit = jnp.where(count > 0, log_blocks / jnp.maximum(count, 1.0), jnp.inf)
    worst = (fit <= jnp.median(fit)).astype(jnp.float32)

    def further(pose: jax.Array, inflation: jax.Array) -> tuple[jax.Array, None]:
        return _moved(pose, compared.terms(pose, inflation)[0], worst), None

    return jax.lax.scan(further, first, jnp.asarray(INFLATIONS[:3], first.dtype))[0]


def _one_motion(compared: _Comparison, start: jax.Array) -> jax.Array:
    """Log density of the frame at the optimum near `start` (7,), not tempered."""
    everything = jnp.ones(BLOCKS.shape[1], start.dtype)

    def further(pose: jax.Array, inflation: jax.Array) -> tuple[jax.Array, None]:
        return _moved(pose, compared.terms(pose, inflation)[0], everything), None

    pose, _ = jax.lax.scan(further, start, jnp.asarray(INFLATIONS, start.dtype))
    log_density = compared.log_blocks(compared.terms(pose, 1.0)[0]).sum()
    return jnp.where(jnp.isfinite(log_density), log_density, -jnp.inf)


def _pair(
    compared: _Comparison, log_one: jax.Array, first: jax.Array, second: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    """EM from two poses (7,): log odds against one motion, and the other fields of `TwoMotions`.

    In the end pixels are tempered as the scores of the blocks ask for, each with its own motion: where
    something moves, the exponent that the filter learns from all blocks as one is too small by far.
    """

    def iteration(
        state: tuple[jax.Array, jax.Array], inflation: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], None]:
        poses, shares = state
        _, log_blocks = jax.vmap(partial(compared.terms, inflation=1.0))(poses)
        terms, _ = jax.vmap(partial(compared.terms, inflation=inflation))(poses)
        belongs = jax.nn.softmax(jnp.log(shares)[:, None] + log_blocks, axis=0)
        shares = jnp.clip(belongs.mean(axis=1), LEAST_SHARE, 1.0 - LEAST_SHARE)
        return (jax.vmap(_moved)(poses, terms, belongs), shares), None

    start = (jnp.stack([first, second]), jnp.full(2, 0.5, first.dtype))
    (poses, shares), _ = jax.lax.scan(iteration, start, jnp.asarray(INFLATIONS, first.dtype))
    terms, log_assigned = jax.vmap(partial(compared.terms, inflation=1.0))(poses)
    belongs = jax.nn.softmax(jnp.log(shares)[:, None] + log_assigned, axis=0)
    covariances, inflations = jax.vmap(_covariance)(terms, belongs)
    exponent = jnp.clip(1.0 / (belongs.mean(axis=1) @ inflations), *EXPONENT_RANGE)
    log_blocks = exponent * jax.vmap(compared.log_blocks)(terms)
    log_two = jax.nn.logsumexp(jnp.log(shares)[:, None] + log_blocks, axis=0).sum()
    count = jnp.maximum(compared.returned.sum(), 1)
    penalty = 0.5 * PARAMETERS * jnp.log(jnp.maximum(exponent * count, 1.0))
    alone = (log_blocks - log_blocks[::-1] > DECISIVE).astype(jnp.float32)
    alone = (terms.inlier * (alone @ BLOCKS.T)).sum(axis=1) / count
    explained = (terms.inlier * (belongs @ BLOCKS.T)).sum() / count
    return PRIOR_LOG_ODDS + log_two - exponent * log_one - penalty, (poses, covariances, alone, explained)


def _covariance(terms: PixelTerms, belongs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of a pose (6, 6), blocks being independent, H^-1 V H^-1, and trace(H^-1 V) / 6 (`NoiseCalibration`)."""
    weight = BLOCKS @ belongs
    precision = (terms.jacobian * (terms.weight * weight)[None]) @ terms.jacobian.T
    scores = (terms.scores() * weight[None]) @ BLOCKS
    inverse = jnp.linalg.inv(precision + STIFFNESS * jnp.eye(6, dtype=precision.dtype))
    spread = inverse @ (scores @ scores.T)
    return spread @ inverse, jnp.trace(spread) / 6.0
