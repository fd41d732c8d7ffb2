"""Local planes: round every pixel a plane fitted robustly to its neighbours, with its covariance.

A plane in space is linear in inverse depth over the image: 1/z = w + g_u du + g_v dv. Neighbours across an
edge are gated out, so that a plane never bridges two surfaces. Through the pixels of a round surface a plane
lies too deep, by as much as the mean of its bend over them; that is taken off, by the change of the slope
from one side of the window to the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from recordings.types import NO_RETURN, DepthNoise
from shapes.depth_noise import standard_deviation
from shapes.geometry.camera import Camera

STEEPEST = 2.0
"""Standard deviation of a surface's slope, depth per lateral metre, before its neighbours are seen."""
STEEPEST_BELIEVED = 4.0
"""A slope of 76 degrees; steeper planes are edges."""
GATE = 3.5
"""Neighbours farther from the plane than this many standard deviations are of another surface."""
BENDING = 0.2
"""Departure of a surface from its plane, as a share of the distance along it."""
FEWEST = 3
"""Parameters of a plane."""
ROUNDS = 3
"""Of reweighting: search effort."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LocalPlanes:
    """One plane for each pixel of an image (H, W).

    Attributes:
        inverse_depth: (H, W) of the plane at the pixel, in 1/m.
        slope: (2, H, W) change of inverse depth per pixel to the right and down.
        covariance: (6, H, W) of depth at the pixel and its two changes per pixel, in m^2: the upper
            triangle 00, 01, 02, 11, 12, 22.
        valid: (H, W) bool, enough neighbours lie on the plane.
    """

    inverse_depth: jax.Array
    slope: jax.Array
    covariance: jax.Array
    valid: jax.Array


@partial(jax.jit, static_argnames="half")
def local_planes(depth_m: jax.Array, camera: Camera, noise: DepthNoise, *, half: int = 1) -> LocalPlanes:
    """Planes of a depth image (H, W) from windows of (2 half + 1) squared pixels."""
    seen = depth_m != NO_RETURN
    z = jnp.where(seen, depth_m, 1.0)
    inverse = jnp.where(seen, 1.0 / z, 0.0)
    pixel_m = z / camera.fx
    sigma = standard_deviation(noise, z)
    size = 2 * half + 1
    offsets = jnp.asarray(np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1).T, depth_m.dtype)
    neighbours = jnp.stack([_shifted(inverse, half, at) for at in np.ndindex(size, size)])

    def refined(plane: jax.Array, first: jax.Array) -> tuple[jax.Array, tuple]:
        offset, slope_u, slope_v = plane
        steep = jnp.sqrt(slope_u**2 + slope_v**2) / pixel_m
        believed = jnp.minimum(1.0, STEEPEST_BELIEVED / jnp.maximum(steep, 1e-9))
        rise_u, rise_v = believed * slope_u, believed * slope_v
        stretch = 1 + (rise_u**2 + rise_v**2) / pixel_m**2

        def added(sums: jax.Array, neighbour: tuple) -> tuple[jax.Array, None]:
            (down, right), inverse_there = neighbour
            rise = -(inverse_there - inverse) * z * z  # depth relative to the pixel's own
            across = (right**2 + down**2) * pixel_m**2
            along = across + (rise_u * right + rise_v * down) ** 2
            variance = sigma**2 + BENDING**2 * along * stretch
            residual = rise - (offset + slope_u * right + slope_v * down)
            limit = GATE * jnp.sqrt(variance + first * sigma**2) + first * STEEPEST * jnp.sqrt(across)
            near = seen & (inverse_there > 0) & (jnp.abs(residual) < limit)
            weight = jnp.where(near, 1.0 / variance, 0.0)
            terms = (1.0, right, down, right * right, right * down, down * down)
            matrix = [weight * term for term in terms]
            pull = [weight * rise * term for term in terms[:3]]
            new = jnp.stack([*matrix, *pull, weight * residual**2, near.astype(rise.dtype)])
            return sums + new, None

        sums = jax.lax.scan(added, jnp.zeros((11, *z.shape), z.dtype), (offsets, neighbours))[0]
        ridge = 1.0 / (STEEPEST * pixel_m) ** 2
        loading = (1e-6, 0.0, 0.0, ridge, 0.0, ridge)
        covariance = _inverse([part + load for part, load in zip(sums[:6], loading, strict=True)])
        misfit, count = sums[9], sums[10]
        scaled = jnp.stack(covariance) * jnp.maximum(1.0, misfit / jnp.maximum(count - 3, 1))[None]
        across = jnp.stack([sums[one] / jnp.maximum(sums[0], 1e-9) for one in (3, 5)])
        return jnp.stack(_times(covariance, list(sums[6:9]))), (scaled, seen & (count >= FEWEST), across)

    start = jnp.zeros((3, *depth_m.shape), depth_m.dtype)
    rounds = jnp.asarray([1.0] + [0.0] * (ROUNDS - 1), depth_m.dtype)
    # loops, since XLA would compute each round anew for every use of it
    (offset, slope_u, slope_v), (covariances, valids, squares) = jax.lax.scan(refined, start, rounds)
    to_inverse = -1.0 / (z * z)
    flat = inverse + offset * to_inverse
    valid, apart = valids[-1], half + 1
    bulge = jnp.zeros_like(flat)
    covariance = covariances[-1]
    for slope, square, slope_variance, axis in zip(
        (slope_u, slope_v), squares[-1], (covariance[3], covariance[5]), (1, 0), strict=True
    ):
        limit = GATE * jnp.hypot(sigma, BENDING * apart * jnp.hypot(pixel_m, slope)) / (z * z)
        bulge += 0.5 * square * _bend(flat, slope * to_inverse, valid, limit, apart, axis)
        covariance = covariance.at[0].add((0.5 * square / apart) ** 2 * slope_variance / 2)
    return LocalPlanes(
        inverse_depth=flat - bulge,
        slope=jnp.stack([slope_u * to_inverse, slope_v * to_inverse]),
        covariance=covariance,
        valid=valid,
    )


def _bend(
    inverse: jax.Array, slope: jax.Array, valid: jax.Array, limit: jax.Array, apart: int, axis: int
) -> jax.Array:
    """Change (H, W) of the planes' slope along an axis, per pixel; 0 where one side is another surface's.

    Args:
        inverse: (H, W) of the planes.
        slope: (H, W) along the axis.
        valid: (H, W).
        limit: (H, W) difference of inverse depth up to which a side's plane continues the pixel's.
        apart: pixels to either side, where windows do not share the middle.
        axis: of the image.
    """
    ahead, behind = (
        [_moved(image, step, axis) for image in (inverse, slope, valid)] for step in (apart, -apart)
    )
    goes_on = [
        there & (jnp.abs(at - inverse - step * slope) < limit)
        for (at, _, there), step in ((ahead, apart), (behind, -apart))
    ]
    return jnp.where(goes_on[0] & goes_on[1], (ahead[1] - behind[1]) / (2 * apart), 0.0)


def _moved(image: jax.Array, step: int, axis: int) -> jax.Array:
    """What stands `step` pixels ahead along an axis of an image (H, W), nothing beyond its border."""
    size = image.shape[axis]
    padded = jnp.pad(image, [(abs(step), abs(step)) if one == axis else (0, 0) for one in range(2)])
    return jax.lax.dynamic_slice_in_dim(padded, abs(step) + step, size, axis)


def _shifted(image: jax.Array, half: int, at: tuple[int, ...]) -> jax.Array:
    """The image moved so that a neighbour, counted from the window's first corner, stands on each pixel."""
    height, width = image.shape
    return jnp.pad(image, half)[at[0] : at[0] + height, at[1] : at[1] + width]


def _inverse(m: list) -> list[jax.Array]:
    """Inverse of symmetric 3x3 matrices given and returned as upper triangles."""
    a, b, c, d, e, f = m
    cofactors = [d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b]
    determinant = a * cofactors[0] + b * cofactors[1] + c * cofactors[2]
    return [entry / determinant for entry in cofactors]


def _times(m: list, v: list) -> list[jax.Array]:
    a, b, c, d, e, f = m
    return [a * v[0] + b * v[1] + c * v[2], b * v[0] + d * v[1] + e * v[2], c * v[0] + e * v[1] + f * v[2]]
