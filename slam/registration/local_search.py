"""Finding a frame's local optimum against the map: enumerate, align, render there, take the curvature."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from recordings.types import DepthNoise
from shapes.geometry import pose_gaussian
from shapes.geometry.pose_sets import IDENTITY
from shapes.geometry.poses import relative_pose
from shapes.stored_kernels import jit_stored
from slam.keyframes.depth_view import CANVAS, CANVAS_WIDTH, CanvasView
from slam.keyframes.rendering import MapImage, fused_planes, render
from slam.likelihood.image_density import (
    STRIDE_PX,
    ScoredPixels,
    log_image_density,
    scored_pixels,
    unmapped_log_penalty,
)
from slam.likelihood.noise_calibration import BIN_EDGES_M
from slam.likelihood.score_variance import score_variance
from slam.registration.alignment import (
    InlierCounts,
    ModelImage,
    Passes,
    PixelTerms,
    align,
    associate,
    pixel_terms,
    projected_scores,
)
from slam.registration.local_map import LocalMap, model_image

STARTS = 4
"""Search effort."""

COARSE_STRIDE_PX = 8
"""Search effort: one pixel in 64 ranks the starts."""

COARSE_SURFACE_SIGMA_M = 0.03
"""Added to the noise while starts are half a grid step off (6 cm)."""

COARSE_SCHEDULE = (Passes(4, (8.0, 4.0, 2.0, 2.0)),)

FINE_SCHEDULE = (Passes(2, (2.0, 1.0, 1.0)), Passes(1, (1.0, 1.0)))

LEAST_GAIN = 0.2
"""Nats a coarse pixel by which a candidate must beat a prediction worth keeping: along a bare wall all score
alike, and their noise must not choose."""

SLIDES = tuple(sign * size for size in (0.0015, 0.003, 0.006, 0.012, 0.024) for sign in (-1, 1))
"""Metres and radians along an eigenvector of the precision."""

WEAK_DIRECTIONS = 2
"""Search effort: a wall leaves two translations and a rotation weak."""

SLIDE_GAIN = 30.0
"""Nats by which a slide must win: on bare walls all score alike."""

LATTICE_STEPS = 6
"""Search effort."""

BLOCK_SIDE_PX = 20
"""Side of the blocks whose scores are taken as independent."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Optimum:
    """A local optimum of the image density for the map of one hypothesis.

    Attributes:
        pose: (7,) reference_from_camera.
        layer_precisions: (M, 6, 6) Gauss-Newton curvature by keyframe, exponent 1, chart at `pose`.
        log_density: log density of the image there, exponent 1.
        agreement: with the map.
        score_variance: (6, 6) variance of the gradient, estimated from the spread of the scores of blocks
            of pixels; equals the precision where pixels are independent and the noise is right.
        squared_ratio: (B,) by depth, sum of inlier probability times squared residual over its variance.
        inlier_count: (B,) by depth, sum of inlier probabilities.
        pixels: the image and what the map shows it.
    """

    pose: jax.Array
    layer_precisions: jax.Array
    log_density: jax.Array
    agreement: InlierCounts
    score_variance: jax.Array
    squared_ratio: jax.Array
    inlier_count: jax.Array
    pixels: ScoredPixels


def local_optimum(
    local_map: LocalMap,
    view: CanvasView,
    noise: DepthNoise,
    starts: jax.Array,
    offsets: jax.Array,
    hold: jax.Array | float,
) -> Optimum:
    """The density's optimum next to the pose that aligns best near the starts.

    The map is rendered at the first start, and anew at that pose. Every start and every offset from the
    first (a grid over position and viewing angle) is scored there; the first start and the best few are
    aligned; the winner is refined. Several kernels: compiled as one they take twice as long (measured, XLA's
    CPU backend).

    Args:
        local_map: what to compare with.
        view: the frame.
        noise: the sensor.
        starts: (S, 7) reference_from_camera, the likeliest first.
        offsets: (G, 6) in the chart at the first start.
        hold: how firmly translations are held at a start, as in `PixelTerms.held_step`.
    """
    compared, ranked = _ranked(local_map, view, noise, starts, offsets)
    fine = _winner(compared, view, noise, ranked, hold)
    return optimum_at(local_map, view, noise, _slid(compared, view, noise, starts[0], fine), hold)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Compared:
    """The map as rendered at the first start, and the view's `unmapped_log_penalty`."""

    model: ModelImage
    log_shortfall: jax.Array

    def scores(
        self, view: CanvasView, noise: DepthNoise, poses: jax.Array, stride_px: int, sigma_m: float = 0.0
    ) -> jax.Array:
        """`projected_scores` (C,) of poses (C, 7), surfaces blurred by `sigma_m`."""
        return projected_scores(self.model, view, self.log_shortfall, noise, poses, stride_px, sigma_m)


@jit_stored()
def _ranked(
    local_map: LocalMap, view: CanvasView, noise: DepthNoise, starts: jax.Array, offsets: jax.Array
) -> tuple[_Compared, jax.Array]:
    """What is compared, and candidates (STARTS, 7) relative to the first start: itself and the best ones."""
    log_shortfall = jax.lax.optimization_barrier(unmapped_log_penalty(view, noise))
    compared = _Compared(model_image(local_map, starts[0], view), log_shortfall)
    relative_starts = jax.vmap(relative_pose, (None, 0))(starts[0], starts)
    identity = jnp.asarray(IDENTITY, starts.dtype)
    grid = jax.vmap(partial(pose_gaussian.displace, identity))(offsets)
    candidates = jax.lax.optimization_barrier(jnp.concatenate([relative_starts, grid]))
    scores = compared.scores(view, noise, candidates, COARSE_STRIDE_PX, COARSE_SURFACE_SIGMA_M)
    _, best = jax.lax.top_k(scores.at[0].set(jnp.inf), STARTS)
    return compared, candidates[best]


@jit_stored()
def _winner(
    compared: _Compared, view: CanvasView, noise: DepthNoise, starts: jax.Array, hold: jax.Array | float
) -> jax.Array:
    """The best (7,) of the starts (STARTS, 7) once they are aligned, aligned finely."""
    align_coarse = partial(align, compared.model, view, noise, hold=hold, schedule=COARSE_SCHEDULE)
    coarse = jax.lax.optimization_barrier(jax.vmap(lambda start: align_coarse(start=start))(starts))
    scores = compared.scores(view, noise, coarse, COARSE_STRIDE_PX // 2)
    lead = jnp.where(hold > 0, LEAST_GAIN * view.depth_m.size / COARSE_STRIDE_PX**2, 0.0)
    winner = coarse[jnp.argmax(scores.at[0].add(lead))]
    return align(compared.model, view, noise, winner, hold, FINE_SCHEDULE)


@jit_stored()
def _slid(
    compared: _Compared, view: CanvasView, noise: DepthNoise, anchor: jax.Array, pose: jax.Array
) -> jax.Array:
    """The best slide (7,) from a pose (7,) relative to the anchor (7,), as reference_from_camera."""
    slid = jax.lax.optimization_barrier(weak_directions(compared.model, view, noise, pose))
    scores = compared.scores(view, noise, slid, FINE_SCHEDULE[0].stride_px)
    best = slid[jnp.argmax(scores.at[0].add(SLIDE_GAIN))]
    return (jaxlie.SE3(anchor) @ jaxlie.SE3(best)).wxyz_xyz


def weak_directions(model: ModelImage, view: CanvasView, noise: DepthNoise, pose: jax.Array) -> jax.Array:
    """Poses (S, 7) from `pose` (7,) itself, the first, along the directions in which it is held least.

    Where walls and a floor fill the image, the little that holds the camera along them lies in a few
    pixels, which count as outliers once it is off by more than they resolve: Gauss-Newton stays there.
    """
    stride = FINE_SCHEDULE[0].stride_px
    planes, variance, observed, rays = associate(model, view, pose, stride)
    terms = pixel_terms(planes, variance, observed, rays, pose, noise)
    _, directions = jnp.linalg.eigh(terms.precision())
    steps = jnp.asarray(SLIDES, pose.dtype)
    offsets = (steps[:, None, None] * directions.T[None, :WEAK_DIRECTIONS]).reshape(-1, 6)
    offsets = jnp.concatenate([jnp.zeros((1, 6), pose.dtype), offsets])
    return jax.vmap(partial(pose_gaussian.displace, pose))(offsets)


def optimum_at(
    local_map: LocalMap, view: CanvasView, noise: DepthNoise, pose: jax.Array, hold: jax.Array | float = 0.0
) -> Optimum:
    """The density's optimum next to `pose` (7,), with the map rendered at `pose`.

    Three kernels: compiled as one they take more than twice as long (measured, XLA's CPU backend).
    """
    keyframes_from_camera, image = _render_at(local_map, view, pose)
    pixels, fused = _fuse_lattice(local_map, view, noise, keyframes_from_camera, image)
    return _climb_from(local_map, noise, pose, hold, pixels, *fused)


@jit_stored()
def _render_at(local_map: LocalMap, view: CanvasView, pose: jax.Array) -> tuple[jax.Array, MapImage]:
    """Keyframes_from_camera (M, 7) at a pose (7,), and the map as it is seen from there."""
    keyframes_from_camera = local_map.keyframes_from_camera(pose)
    surfaces, present = local_map.surfaces, local_map.present
    return keyframes_from_camera, render(surfaces, present, keyframes_from_camera, view.rays, view.camera)


@jit_stored()
def _fuse_lattice(
    local_map: LocalMap,
    view: CanvasView,
    noise: DepthNoise,
    keyframes_from_camera: jax.Array,
    image: MapImage,
) -> tuple[ScoredPixels, tuple[jax.Array, jax.Array]]:
    """The pixels that count, and their `fused_planes`."""
    surfaces, present = local_map.surfaces, local_map.present
    pixels = scored_pixels(view, image, surfaces, present, keyframes_from_camera, noise)
    return pixels, fused_planes(MapImage(pixels.planes, pixels.weights), keyframes_from_camera)


@jit_stored()
def _climb_from(
    local_map: LocalMap,
    noise: DepthNoise,
    pose: jax.Array,
    hold: jax.Array | float,
    pixels: ScoredPixels,
    lattice_planes: jax.Array,
    lattice_variance: jax.Array,
) -> Optimum:
    """The optimum next to a pose (7,) where pixels see these planes (3, P), of depth variance (P,)."""
    identity = jnp.asarray(IDENTITY, pose.dtype)

    def terms_at(relative: jax.Array) -> PixelTerms:
        return pixel_terms(lattice_planes, lattice_variance, pixels.observed_m, pixels.rays, relative, noise)

    def climb(relative: jax.Array, _: None) -> tuple[jax.Array, None]:
        step = terms_at(relative).held_step(pose_gaussian.coordinates(identity, relative), hold)
        return pose_gaussian.displace(relative, step), None

    relative, _ = jax.lax.scan(climb, identity, None, length=LATTICE_STEPS)
    terms = jax.lax.optimization_barrier(terms_at(relative))
    optimum = (jaxlie.SE3(pose) @ jaxlie.SE3(relative)).wxyz_xyz
    log_density = log_image_density(
        pixels, local_map.keyframes_from_camera(optimum), noise, jnp.ones((), pose.dtype)
    )
    shares = pixels.weights * lattice_variance[None]
    layer_precisions = jnp.stack(
        [(terms.jacobian * (terms.weight * share)[None]) @ terms.jacobian.T for share in shares]
    )
    depth_bin = jnp.searchsorted(jnp.asarray(BIN_EDGES_M[1:-1], jnp.float32), pixels.observed_m)
    in_bin = jax.nn.one_hot(depth_bin, len(BIN_EDGES_M) - 1)
    return Optimum(
        pose=optimum,
        layer_precisions=layer_precisions,
        log_density=log_density,
        agreement=terms.agreement,
        score_variance=_score_variance(terms),
        squared_ratio=(terms.weight * terms.residual**2) @ in_bin,
        inlier_count=terms.inlier @ in_bin,
        pixels=pixels,
    )


def _score_variance(terms: PixelTerms) -> jax.Array:
    """Variance (6, 6) of the sum of scores of the lattice, from its blocks of pixels."""
    membership = jnp.asarray(block_membership(STRIDE_PX))
    products = terms.jacobian[:, None] * (terms.jacobian * terms.weight[None])[None]
    curvatures = (products.reshape(36, -1) @ membership).T.reshape(-1, 6, 6)
    return score_variance((terms.scores() @ membership).T, curvatures)


def block_membership(stride_px: int) -> np.ndarray:
    """Which block each pixel of a lattice of the canvas is in, one-hot (P, B)."""
    rows, columns = (np.arange(0, size, stride_px) // BLOCK_SIDE_PX for size in CANVAS)
    block = rows[:, None] * (CANVAS_WIDTH // BLOCK_SIDE_PX) + columns
    return np.eye(block.max() + 1, dtype=np.float32)[block.ravel()]
