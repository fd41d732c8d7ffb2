"""p(I_t | x_t, map): the whole image as seen from a candidate pose, one normalised factor per pixel.

The map is rendered once, near the candidates (`slam.rendering`): each pixel then knows which surface
elements it sees. A candidate intersects its own rays with the tangent planes of those elements, so the
rendered depth never depends on the observed one.

Where the map shows nothing the world is not empty but unknown, and surfaces are smooth: the factor of
such a pixel is its density given the two pixels to its left: Laplace around the plane through them and
around the nearer one's depth, mixed with the uniform. Read from left to right, the factors multiply to
a normalised density of the image. The same density, cut off at the map's surface, stands for things in
front of it that no keyframe has seen. (With uniforms alone, wrong places that cover more of the image
beat the right one when views are far apart: at 72 degrees round an object, by thousands of nats.)

Approximations, tested against rendering at the candidate itself: which element a pixel sees is that of
the nearby rendering, and a surface is its tangent plane over the few pixels that candidates differ by.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jaxlie

from recordings.types import NO_RETURN, DepthNoise
from shapes import depth_noise
from slam.components import dot, rotated
from slam.depth_view import DepthView
from slam.rendering import LEAST_INVERSE_DEPTH, MapImage

STRIDE_PX = 2
"""The density counts the pixels of this lattice; the exponents of the others are zero."""
UNKNOWN_NONE_PROBABILITY = 0.5
UNSEEN_IN_FRONT = 0.01
"""Probability that something no keyframe has seen stands in front of the map's surface."""
UNKNOWN_SHARES = (0.7, 0.2, 0.1)
"""Of unknown surfaces: those that continue the plane to the left, the depth to the left, and any other."""
UNKNOWN_SCALES = (0.008, 0.06)
"""Laplace scales of the first two, relative to the depth expected."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ScoredPixels:
    """The lattice of pixels that the density counts, and what the map shows there.

    Attributes:
        observed_m: (P,) depth, `NO_RETURN` where none.
        measured: (P,) bool, False for canvas outside of the image.
        expected_m: (2, P) depths that the pixels to the left suggest, `NO_RETURN` where they do not.
        rays: (3, P).
        planes: (M, 3, P) in the keyframes' frames.
        weights: (M, P) inverse variances in 1/m^2.
    """

    observed_m: jax.Array
    measured: jax.Array
    expected_m: jax.Array
    rays: jax.Array
    planes: jax.Array
    weights: jax.Array


def log_density_of_unknown(observed_m: jax.Array, expected_m: jax.Array, noise: DepthNoise) -> jax.Array:
    """Log density of returns (...) from surfaces of which only the pixels to the left tell.

    sum_j s_j Laplace(z; e_j, c_j e_j) + s_any 1[0 <= z <= D] / D with expectations e (2, ...), whose
    shares go to the uniform where there is none. Base measure: Lebesgue, metres.
    """
    inside = (observed_m >= 0) & (observed_m <= noise.max_range_m)
    density = _uniform_share(expected_m) * jnp.where(inside, 1.0 / noise.max_range_m, 0.0)
    for index, (share, relative_scale) in enumerate(zip(UNKNOWN_SHARES[:2], UNKNOWN_SCALES, strict=True)):
        expected = expected_m[index]
        known = expected > NO_RETURN
        scale = relative_scale * jnp.where(known, expected, 1.0)
        laplace = jnp.exp(-jnp.abs(observed_m - expected) / scale) / (2.0 * scale)
        density += jnp.where(known, share * laplace, 0.0)
    return jnp.log(density)


def probability_nearer(depth_m: jax.Array, expected_m: jax.Array, noise: DepthNoise) -> jax.Array:
    """Probability that an unknown surface is nearer than `depth_m`: the same density's integral."""
    total = _uniform_share(expected_m) * jnp.clip(depth_m / noise.max_range_m, 1e-3, 1.0)
    for index, (share, relative_scale) in enumerate(zip(UNKNOWN_SHARES[:2], UNKNOWN_SCALES, strict=True)):
        expected = expected_m[index]
        known = expected > NO_RETURN
        scale = relative_scale * jnp.where(known, expected, 1.0)
        tail = 0.5 * jnp.exp(-jnp.abs(depth_m - expected) / scale)
        total += jnp.where(known, share * jnp.where(depth_m < expected, tail, 1.0 - tail), 0.0)
    return total


def _uniform_share(expected_m: jax.Array) -> jax.Array:
    planar, level = (jnp.where(expected_m[i] > NO_RETURN, 0.0, UNKNOWN_SHARES[i]) for i in range(2))
    return UNKNOWN_SHARES[2] + planar + level


def expected_from_the_left(lattice_m: jax.Array) -> jax.Array:
    """Depths (2, H, W) at the pixels of a lattice (H, W): on the plane of the two to the left, and of one.

    In a pinhole image inverse depth is affine along a plane: 1/z = 2/z_1 - 1/z_2.
    """
    near = jnp.pad(lattice_m[:, :-1], ((0, 0), (1, 0)))
    far = jnp.pad(lattice_m[:, :-2], ((0, 0), (2, 0)))
    both = (near > NO_RETURN) & (far > NO_RETURN)
    inverse = 2.0 / jnp.where(both, near, 1.0) - 1.0 / jnp.where(both, far, 1.0)
    ahead = both & (inverse > 0.5 / jnp.where(both, near, 1.0))
    return jnp.stack([jnp.where(ahead, 1.0 / jnp.where(ahead, inverse, 1.0), NO_RETURN), near])


def log_unknown_factors(observed_m: jax.Array, expected_m: jax.Array, noise: DepthNoise) -> jax.Array:
    """Log factors of pixels where the map shows nothing: the atom of no return, or an unknown surface."""
    return jnp.where(
        observed_m == NO_RETURN,
        jnp.log(UNKNOWN_NONE_PROBABILITY),
        jnp.log1p(-UNKNOWN_NONE_PROBABILITY) + log_density_of_unknown(observed_m, expected_m, noise),
    )


def log_hit_factors(
    observed_m: jax.Array, expected_m: jax.Array, depth_m: jax.Array, sigma_m: jax.Array, noise: DepthNoise
) -> jax.Array:
    """Log factors of pixels whose rays meet the map at `depth_m`, known to `sigma_m`."""
    log_surface = depth_noise.log_density_of_hit(noise, observed_m, depth_m, sigma_m)
    log_in_front = (
        jnp.log1p(-noise.none_hit_probability)
        + log_density_of_unknown(observed_m, expected_m, noise)
        - jnp.log(probability_nearer(depth_m, expected_m, noise))
    )
    log_in_front = jnp.where(observed_m < depth_m, log_in_front, -jnp.inf)
    return jnp.where(
        observed_m == NO_RETURN,
        log_surface,
        jnp.logaddexp(jnp.log1p(-UNSEEN_IN_FRONT) + log_surface, jnp.log(UNSEEN_IN_FRONT) + log_in_front),
    )


def scored_pixels(view: DepthView, image: MapImage) -> ScoredPixels:
    """The lattice of a view against the map's image from nearby."""
    every = slice(None, None, STRIDE_PX)
    layers = len(image.planes)
    return ScoredPixels(
        observed_m=view.depth_m[every, every].ravel(),
        measured=view.measured[every, every].ravel(),
        expected_m=expected_from_the_left(view.depth_m[every, every]).reshape(2, -1),
        rays=view.rays[:, every, every].reshape(3, -1),
        planes=image.planes[:, :, every, every].reshape(layers, 3, -1),
        weights=image.weights[:, every, every].reshape(layers, -1),
    )


def rendered_depth(pixels: ScoredPixels, keyframes_from_camera: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Depth (P,) that a camera at (M, 7) sees, +inf for a miss, and its variance (P,)."""

    def layer(planes: jax.Array, weights: jax.Array, pose: jax.Array) -> tuple[jax.Array, jax.Array]:
        keyframe_from_camera = jaxlie.SE3(pose)
        slope = dot(planes, rotated(keyframe_from_camera.rotation().as_matrix(), pixels.rays))
        height = 1.0 - dot(keyframe_from_camera.translation(), planes)
        ahead = (weights > 0) & (height > 0) & (slope > LEAST_INVERSE_DEPTH * height)
        return jnp.where(ahead, height / jnp.where(ahead, slope, 1.0), 0.0), jnp.where(ahead, weights, 0.0)

    total, weighted = jnp.zeros_like(pixels.observed_m), jnp.zeros_like(pixels.observed_m)
    for index in range(len(keyframes_from_camera)):
        depth, weights = layer(pixels.planes[index], pixels.weights[index], keyframes_from_camera[index])
        total, weighted = total + weights, weighted + weights * depth
    hit = total > 0
    safe_total = jnp.where(hit, total, 1.0)
    return jnp.where(hit, weighted / safe_total, jnp.inf), 1.0 / safe_total


def log_image_density(
    pixels: ScoredPixels, keyframes_from_camera: jax.Array, noise: DepthNoise, exponent: jax.Array | float
) -> jax.Array:
    """Tempered log density of the image from the pose that sees the map's keyframes at (M, 7)."""
    depth, variance = rendered_depth(pixels, keyframes_from_camera)
    hit = jnp.isfinite(depth)
    log_factors = jnp.where(
        hit,
        log_hit_factors(
            pixels.observed_m, pixels.expected_m, jnp.where(hit, depth, 1.0), jnp.sqrt(variance), noise
        ),
        log_unknown_factors(pixels.observed_m, pixels.expected_m, noise),
    )
    return exponent * jnp.where(pixels.measured, log_factors, 0.0).sum()
