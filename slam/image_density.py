"""p(I_t | x_t, map): the whole image as seen from a candidate pose, one normalised factor per pixel.

The map is rendered once, near the candidates (`slam.rendering`): each pixel then knows which surface
elements it sees. A candidate intersects its own rays with the tangent planes of those elements, so the
rendered depth never depends on the observed one. Pixels that see nothing have the density of a miss.

Approximations, tested against rendering at the candidate itself: which element a pixel sees is that of
the nearby rendering, and a surface is its tangent plane over the few pixels that candidates differ by.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jaxlie

from recordings.types import DepthNoise
from shapes import depth_noise
from slam.components import dot, rotated
from slam.depth_view import DepthView
from slam.rendering import LEAST_INVERSE_DEPTH, MapImage

STRIDE_PX = 2
"""The density counts the pixels of this lattice; the exponents of the others are zero."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ScoredPixels:
    """The lattice of pixels that the density counts, and what the map shows there.

    Attributes:
        observed_m: (P,) depth, `NO_RETURN` where none.
        measured: (P,) bool, False for canvas outside of the image.
        rays: (3, P).
        planes: (M, 3, P) in the keyframes' frames.
        weights: (M, P) inverse variances in 1/m^2.
    """

    observed_m: jax.Array
    measured: jax.Array
    rays: jax.Array
    planes: jax.Array
    weights: jax.Array


def scored_pixels(view: DepthView, image: MapImage) -> ScoredPixels:
    """The lattice of a view against the map's image from nearby."""
    every = slice(None, None, STRIDE_PX)
    layers = len(image.planes)
    return ScoredPixels(
        observed_m=view.depth_m[every, every].ravel(),
        measured=view.measured[every, every].ravel(),
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
    log_factors = depth_noise.log_density(noise, pixels.observed_m, depth, jnp.sqrt(variance))
    return exponent * jnp.where(pixels.measured, log_factors, 0.0).sum()
