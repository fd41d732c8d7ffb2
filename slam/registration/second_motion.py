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
import numpy as np

from recordings.types import NO_RETURN, DepthNoise
from shapes.geometry import pose_gaussian
from slam.keyframes.depth_view import CANVAS_HEIGHT, CANVAS_WIDTH, CanvasView
from slam.keyframes.rendering import ONE_SURFACE_BAND, render
from slam.keyframes.surfels import SurfelImage
from slam.likelihood.image_density import STRIDE_PX, log_pixel_factors, rendered_depth, scored_pixels
from slam.likelihood.noise_calibration import EXPONENT_RANGE
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


@dataclass(frozen=True)
class _Comparison:
    """A frame against the reference, at any pose (7,) of its camera there."""

    reference: SurfelImage
    view: CanvasView
    noise: DepthNoise

    def log_factors(self, pose: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Of pixels (P,), over that of the unknown, not tempered; and which of them show a known surface.

        Not at outlines: how elements were rounded decides which of two surfaces a pixel sees there.
        """
        surfaces, present = jax.tree.map(lambda leaf: leaf[None], self.reference), jnp.ones(1, bool)
        image = render(surfaces, present, pose[None], self.view.rays, self.view.camera)
        pixels = scored_pixels(self.view, image, surfaces, present, pose[None], self.noise)
        log_density, log_unknown = log_pixel_factors(pixels, pose[None], self.noise)
        shown = _within_a_surface(rendered_depth(pixels, pose[None])[0]) & self.returned(STRIDE_PX)
        return _thinned(jnp.where(shown, log_density - log_unknown, 0.0)), _thinned(shown)

    def log_blocks(self, pose: jax.Array, counted: jax.Array) -> jax.Array:
        """The same of blocks (B,), the pixels (P,) that are `counted`."""
        return jnp.where(counted, self.log_factors(pose)[0], 0.0) @ BLOCKS

    def terms(self, pose: jax.Array, inflation: jax.Array | float) -> tuple[PixelTerms, jax.Array]:
        """Of pixels at a pose (7,), and tempered log densities (B,) of the blocks over that of outliers."""
        model = ModelImage(self.reference.planes, self.reference.variance_m2, self.reference.camera)
        planes, variance, observed, rays = associate(model, self.view, pose, COMPARED_STRIDE_PX)
        terms = pixel_terms(planes, variance, observed, rays, pose, self.noise, inflation)
        log_ratio = -jnp.log1p(-jnp.minimum(terms.inlier, 1.0 - jnp.finfo(jnp.float32).eps))
        return terms, ASSIGNING_EXPONENT * (log_ratio @ BLOCKS)

    def returned(self, stride_px: int = COMPARED_STRIDE_PX) -> jax.Array:
        """Which of the pixels (P,) of a lattice have a depth."""
        return self.view.depth_m[::stride_px, ::stride_px].ravel() > NO_RETURN


def _within_a_surface(depth_m: jax.Array) -> jax.Array:
    """Which pixels (P,) of the density's lattice are not beside a step in depth (P,), +inf where unknown.

    Along a plane inverse depth is affine.
    """
    inverse = 1.0 / depth_m.reshape(CANVAS_HEIGHT // STRIDE_PX, -1)
    padded = jnp.pad(inverse, 1, mode="edge")
    down = padded[2:, 1:-1] + padded[:-2, 1:-1] - 2.0 * inverse
    right = padded[1:-1, 2:] + padded[1:-1, :-2] - 2.0 * inverse
    step = jnp.maximum(jnp.abs(down), jnp.abs(right))
    return ((inverse > 0) & (step < ONE_SURFACE_BAND * inverse)).ravel()


def _thinned(values: jax.Array) -> jax.Array:
    """Those of the image density's lattice that are compared."""
    every = COMPARED_STRIDE_PX // STRIDE_PX
    return values.reshape(CANVAS_HEIGHT // STRIDE_PX, -1)[::every, ::every].ravel()


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
    reference: SurfelImage,
    view: CanvasView,
    noise: DepthNoise,
    first: jax.Array,
    second: jax.Array,
) -> TwoMotions:
    """The pair of motions that explains a frame best, of those to which EM leads from two starts.

    Beside `second` this is where those blocks lead that fit `first` worst. Where nothing contradicts the
    first motion there is nothing to find.

    Args:
        reference: an earlier view, in its camera's frame.
        view: the frame.
        noise: the sensor.
        first: (7,) reference_from_camera, where the frame was found.
        second: (7,) where else it may be.
    """
    compared = _Comparison(reference, view, noise)
    log_factors, shown = compared.log_factors(first)
    count = jnp.maximum(compared.returned().sum(), 1)

    def search() -> TwoMotions:
        seconds = jnp.stack([second, _led_by_the_worst(compared, first, log_factors)])
        log_one, counted = _one_motion(compared, first, second, log_factors, shown)
        log_odds, pairs = jax.vmap(partial(_pair, compared, counted, log_one, first))(seconds)
        log_odds = jnp.where(jnp.isfinite(log_odds), log_odds, -jnp.inf)
        best = jnp.argmax(log_odds)
        poses, covariances, shares, either = (leaf[best] for leaf in pairs)
        return TwoMotions(poses, covariances, shares, either, log_odds[best])

    def none() -> TwoMotions:
        never = jnp.asarray(-jnp.inf, first.dtype)
        spreads, shares = jnp.zeros((2, 6, 6), first.dtype), jnp.zeros(2, first.dtype)
        return TwoMotions(jnp.stack([first, first]), spreads, shares, shown.sum() / count, never)

    contradiction = -jnp.minimum(log_factors @ BLOCKS, 0.0).sum()
    return jax.lax.cond(contradiction < -PRIOR_LOG_ODDS, none, search)


def _led_by_the_worst(compared: _Comparison, first: jax.Array, log_factors: jax.Array) -> jax.Array:
    """The pose (7,) to which the half of the blocks leads whose pixels (P,) fit `first` worst."""
    count = compared.returned().astype(jnp.float32) @ BLOCKS
    fit = jnp.where(count > 0, log_factors @ BLOCKS / jnp.maximum(count, 1.0), jnp.inf)
    worst = (fit <= jnp.median(fit)).astype(jnp.float32)

    def further(pose: jax.Array, inflation: jax.Array) -> tuple[jax.Array, None]:
        return _moved(pose, compared.terms(pose, inflation)[0], worst), None

    return jax.lax.scan(further, first, jnp.asarray(INFLATIONS[:3], first.dtype))[0]


def _one_motion(
    compared: _Comparison, first: jax.Array, second: jax.Array, log_factors: jax.Array, shown: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Log density of the frame by one motion, not tempered, and the pixels (P,) of which that says anything.

    The best of `first`, whose `log_factors` (P,) and pixels `shown` are given, and the optima near both.
    """
    everything = jnp.ones(BLOCKS.shape[1], first.dtype)

    def optimum(start: jax.Array) -> tuple[jax.Array, jax.Array]:
        def further(pose: jax.Array, inflation: jax.Array) -> tuple[jax.Array, None]:
            return _moved(pose, compared.terms(pose, inflation)[0], everything), None

        pose, _ = jax.lax.scan(further, start, jnp.asarray(INFLATIONS, start.dtype))
        return compared.log_factors(pose)

    optima, shown_there = jax.vmap(optimum)(jnp.stack([first, second]))
    log_densities = jnp.concatenate([log_factors[None], optima]).sum(axis=1)
    log_densities = jnp.where(jnp.isfinite(log_densities), log_densities, -jnp.inf)
    best = jnp.argmax(log_densities)
    return log_densities[best], jnp.concatenate([shown[None], shown_there])[best]


def _pair(
    compared: _Comparison, counted: jax.Array, log_one: jax.Array, first: jax.Array, second: jax.Array
) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    """EM from two poses (7,): log odds against one motion on pixels (P,), and the fields of `TwoMotions`.

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
    log_blocks = exponent * jax.vmap(partial(compared.log_blocks, counted=counted))(poses)
    log_two = jax.nn.logsumexp(jnp.log(shares)[:, None] + log_blocks, axis=0).sum()
    count = jnp.maximum(compared.returned().sum(), 1)
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
