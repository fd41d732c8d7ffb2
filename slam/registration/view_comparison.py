"""A frame against one earlier view of the same camera, at any pose: pixel by pixel, in blocks."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from recordings.types import NO_RETURN, DepthNoise
from slam.keyframes.depth_view import CANVAS_HEIGHT, ONE_SURFACE_BAND, CanvasView
from slam.keyframes.rendering import render
from slam.keyframes.surfels import SurfelImage
from slam.likelihood.image_density import STRIDE_PX, log_pixel_factors, rendered_depth, scored_pixels
from slam.registration.alignment import ModelImage, PixelTerms, associate, pixel_terms
from slam.registration.local_search import block_membership

COMPARED_STRIDE_PX = 4
"""Search effort: one pixel in 16."""

ASSIGNING_EXPONENT = 0.4
"""Tempering while blocks are assigned: what the filter begins with (`NoiseCalibration.initial`), on a quarter
of its pixels."""

BLOCKS = block_membership(COMPARED_STRIDE_PX)
"""Which block each compared pixel is in, one-hot (P, B): those move as one whose scores are independent."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ViewComparison:
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

    def terms(self, pose: jax.Array, inflation: jax.Array | float) -> tuple[PixelTerms, jax.Array]:
        """Of pixels at a pose (7,), and tempered log densities (B,) of the blocks over that of outliers."""
        model = ModelImage(self.reference.planes, self.reference.variance_m2, self.reference.camera)
        planes, variance, observed, rays = associate(model, self.view, pose, COMPARED_STRIDE_PX)
        terms = pixel_terms(planes, variance, observed, rays, pose, self.noise, inflation)
        log_ratio = -jnp.log1p(-jnp.minimum(terms.inlier, 1.0 - jnp.finfo(jnp.float32).eps))
        return terms, ASSIGNING_EXPONENT * (log_ratio @ BLOCKS)

    def returned(self, stride_px: int = COMPARED_STRIDE_PX) -> jax.Array:
        """Which of the pixels (P,) of a lattice have a depth."""
        return self.view.lattice(stride_px)[0] > NO_RETURN


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
