"""p(I_t | x_t, map): the whole image as seen from a candidate pose, one normalised factor per pixel.

The map is rendered once, near the candidates (`slam.keyframes.rendering`); each pixel then knows which
surface elements it sees. A candidate intersects its own rays with the tangent planes of those elements, so
that the rendered depth never depends on the observed one.

Where the map is empty the world is unknown, and depth has the predictive density of
`slam.likelihood.unmapped_depth`. The same density, truncated at the map's surface, holds for occluders that
no keyframe has seen. They are rare but coherent: where the neighbouring pixels are occluded the next one
probably is too. (With independent pixels the back of an object that occludes the map cost the right pose, 72
degrees round it, hundreds of nats.)

Approximations, tested against rendering at the candidate itself: which element a pixel sees is that of the
nearby rendering, and a surface is its tangent plane over the few pixels by which candidates differ.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise
from shapes.geometry.poses import transformed
from slam.keyframes.depth_view import ONE_SURFACE_BAND, CanvasView
from slam.keyframes.rendering import MapImage, depth_from, neighbours, pixels_of
from slam.keyframes.surfels import SurfelImage
from slam.likelihood.unmapped_depth import (
    PredictedDepth,
    log_density_of_unknown,
    predict_from_neighbours,
    probability_nearer,
)

LOG_ROOT_TWO_PI = 0.9189385332046727
"""log sqrt(2 pi)."""

STRIDE_PX = 2
"""The density counts the pixels of this lattice; the exponents of the others are zero."""

UNSEEN_IN_FRONT = 0.01
"""Probability that something no keyframe has seen stands in front of the map's surface."""

STILL_IN_FRONT = 0.8
"""The same where the pixels before suggest it, and no keyframe saw through the space there."""

IN_FRONT_SIGMAS = 5.0
"""Beyond five sigma a depth is no noise of the surface."""

ENDS_BEFORE = 0.2
"""Probability that the map's surface ends before the last pixel that is rendered of it: at true poses a fifth
of those pixels saw past it, and hardly any others (views of an object; docs/model.md,
development films)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ScoredPixels:
    """The lattice of pixels that the density counts, and what the map shows there.

    Attributes:
        observed_m: (P,) depth, `NO_RETURN` where none.
        measured: (P,) bool, False for canvas outside of the image.
        foreseen: (P,) what the pixels before suggest.
        in_front: (P,) whether that is in front of the map, in space that no keyframe saw through.
        border: (P,) whether the map shows nothing in one of the eight pixels around.
        rays: (3, P).
        planes: (M, 3, P) in the keyframes' frames.
        weights: (M, P) inverse variances in 1/m^2.
    """

    observed_m: jax.Array
    measured: jax.Array
    foreseen: PredictedDepth
    in_front: jax.Array
    border: jax.Array
    rays: jax.Array
    planes: jax.Array
    weights: jax.Array


def unmapped_log_penalty(view: CanvasView, noise: DepthNoise) -> jax.Array:
    """By how much returns (H, W) of the lattice are less probable, in logs, than were their surfaces known.

    A search that blurs what is known has to blur what is unknown as well, or it looks away.
    """
    observed_m = view.depth_m[::STRIDE_PX, ::STRIDE_PX]
    log_unknown = log_density_of_unknown(observed_m, predict_from_neighbours(observed_m, noise), noise)
    sigma = depth_noise.standard_deviation(noise, observed_m)
    return log_unknown + jnp.log(sigma) + LOG_ROOT_TWO_PI


def log_density_of_mapped(
    observed_m: jax.Array,
    foreseen: PredictedDepth,
    in_front: jax.Array,
    depth_m: jax.Array,
    sigma_m: jax.Array,
    noise: DepthNoise,
) -> jax.Array:
    """Log density of returns whose rays meet the map at `depth_m`, known to `sigma_m`.

    `in_front` as in `ScoredPixels`. Base measure: Lebesgue, metres.
    """
    probability = jnp.where(in_front, STILL_IN_FRONT, UNSEEN_IN_FRONT)
    returning = replace(noise, none_hit_probability=0.0)
    log_surface = depth_noise.log_density_of_hit(returning, observed_m, depth_m, sigma_m)
    log_unknown = log_density_of_unknown(observed_m, foreseen, noise)
    log_in_front = log_unknown - jnp.log(probability_nearer(depth_m, foreseen, noise))
    log_in_front = jnp.where(observed_m < depth_m, log_in_front, -jnp.inf)
    return jnp.logaddexp(jnp.log1p(-probability) + log_surface, jnp.log(probability) + log_in_front)


def scored_pixels(
    view: CanvasView,
    image: MapImage,
    surfaces: SurfelImage,
    present: jax.Array,
    keyframes_from_camera: jax.Array,
    noise: DepthNoise,
) -> ScoredPixels:
    """The lattice of a view against the map's image from nearby, by `slam.keyframes.rendering`."""
    every = slice(None, None, STRIDE_PX)
    layers = len(image.planes)
    foreseen = jax.tree.map(
        lambda leaf: leaf.reshape(*leaf.shape[:-2], -1),
        predict_from_neighbours(view.depth_m[every, every], noise),
    )
    observed, rays = view.lattice(STRIDE_PX)
    pixels = ScoredPixels(
        observed_m=observed,
        measured=view.measured[every, every].ravel(),
        foreseen=foreseen,
        in_front=jnp.zeros(foreseen.share.shape, bool),
        border=_beside_nothing(image.weights[:, every, every].sum(0) > 0).ravel(),
        rays=rays,
        planes=image.planes[:, :, every, every].reshape(layers, 3, -1),
        weights=image.weights[:, every, every].reshape(layers, -1),
    )
    depth, variance = rendered_depth(pixels, keyframes_from_camera)
    suggested = foreseen.likeliest_m
    spread = jnp.sqrt(depth_noise.standard_deviation(noise, suggested) ** 2 + variance)
    shown = jnp.isfinite(depth) & (suggested > NO_RETURN)
    before = shown & (suggested < depth - IN_FRONT_SIGMAS * spread)
    through = _seen_through(rays * suggested[None], surfaces, present, keyframes_from_camera)
    return replace(pixels, in_front=before & ~through)


def _beside_nothing(shown: jax.Array) -> jax.Array:
    """Pixels (H, W) of whose neighbours some are not `shown`; beyond the image all are."""
    return ~jnp.stack(neighbours(shown, True)).all(0)


def _seen_through(
    points: jax.Array, surfaces: SurfelImage, present: jax.Array, keyframes_from_camera: jax.Array
) -> jax.Array:
    """Whether any of the M keyframes saw something behind each of a camera's points (3, P)."""
    through = jnp.zeros(points.shape[1], bool)
    for index in range(len(present)):
        surface = jax.tree.map(lambda leaf, index=index: leaf[index], surfaces)
        in_keyframe = transformed(keyframes_from_camera[index], points)
        pixel, inside = pixels_of(in_keyframe, surface.camera)
        behind = in_keyframe[2] < (1.0 - ONE_SURFACE_BAND) * surface.depth_m.ravel()[pixel]
        through |= present[index] & inside & behind
    return through


def rendered_depth(pixels: ScoredPixels, keyframes_from_camera: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Depth (P,) that a camera at (M, 7) sees, +inf for a miss, and its variance (P,)."""
    total, weighted = jnp.zeros_like(pixels.observed_m), jnp.zeros_like(pixels.observed_m)
    for index in range(len(keyframes_from_camera)):
        depth, _, ahead = depth_from(keyframes_from_camera[index], pixels.planes[index], pixels.rays)
        weights = jnp.where(ahead, pixels.weights[index], 0.0)
        total, weighted = total + weights, weighted + weights * depth
    hit = total > 0
    safe_total = jnp.where(hit, total, 1.0)
    return jnp.where(hit, weighted / safe_total, jnp.inf), 1.0 / safe_total


def log_image_density(
    pixels: ScoredPixels, keyframes_from_camera: jax.Array, noise: DepthNoise, exponent: jax.Array | float
) -> jax.Array:
    """Tempered log density of the image from the pose that sees the map's keyframes at (M, 7)."""
    return exponent * log_pixel_factors(pixels, keyframes_from_camera, noise)[0].sum()


def log_pixel_factors(
    pixels: ScoredPixels, keyframes_from_camera: jax.Array, noise: DepthNoise
) -> tuple[jax.Array, jax.Array]:
    """Log densities (P,) of the pixels from that pose, and (P,) were the map empty.

    A pixel that sees an element in the nearby rendering is held against it: from a pose where that turns its
    back the rendering no longer holds, and must not make the known unknown.
    """
    depth, variance = rendered_depth(pixels, keyframes_from_camera)
    hit, seen = jnp.isfinite(depth), (pixels.weights > 0).any(0)
    returned = pixels.observed_m > NO_RETURN
    observed = jnp.where(returned, pixels.observed_m, 1.0)
    log_unknown = log_density_of_unknown(observed, pixels.foreseen, noise)
    log_hit = log_density_of_mapped(
        observed, pixels.foreseen, pixels.in_front, jnp.where(hit, depth, 1.0), jnp.sqrt(variance), noise
    )
    log_hit = jnp.where(hit, log_hit, jnp.log(noise.outlier_probability / noise.max_range_m))
    ends = jnp.where(pixels.border, ENDS_BEFORE, 0.0)
    log_shown = jnp.logaddexp(jnp.log1p(-ends) + log_hit, jnp.log(ends) + log_unknown)

    def factors(log_depth: jax.Array) -> jax.Array:
        log_return = jnp.log1p(-pixels.foreseen.none) + log_depth
        log_factors = jnp.where(returned, log_return, jnp.log(pixels.foreseen.none))
        return jnp.where(pixels.measured, log_factors, 0.0)

    return factors(jnp.where(seen, log_shown, log_unknown)), factors(log_unknown)
