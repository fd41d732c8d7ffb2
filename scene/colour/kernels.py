"""Gains of many things at once, compiled: Laplace's evidence of their pixels, less as these are explained.

Float32: for searching. What is reported is weighed by `posterior`. Things are the last axis of all arrays,
along which a processor works on several at once.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from numpy.typing import NDArray

from scene.colour.density import BIN, CELLS, LEAST, STORED
from scene.colour.world import Layers, TableWorld

FITS = 3
"""Steps of expectation and maximisation after the vote; two more change evidences by 0.05 nats."""
TOGETHER = 64
"""Things of a batch, of like numbers of pixels: their arrays stay in a core's cache."""
LEAST_THINGS, PIXELS = 8, 64
"""Batches are filled up, to a power of two and to a multiple: a dozen shapes to compile in all."""


def log_gains(
    world: TableWorld,
    colour: NDArray[np.float64],
    explained: NDArray[np.float64],
    depth_m: NDArray[np.float64],
    layers: Layers,
) -> NDArray[np.float64]:
    """What each of B things alone would add to the log evidence, (B,).

    Args:
        world: of the things.
        colour: (H * W, C) of the image; +inf or -inf where it was clipped.
        explained: (H * W,) log density of each pixel as it is explained without the thing.
        depth_m: (H * W,) of what stands there already, +inf over the table.
        layers: of the things.
    """
    beyond = len(colour)
    arrays = (
        np.pad(colour.T, ((0, 0), (0, 1))).astype(np.float32),
        np.append(explained, 0.0).astype(np.float32),
        np.append(depth_m, -np.inf).astype(np.float32),
    )
    clipped = bool(np.isinf(colour).any())
    face_colours = world.face_colours(colour.shape[1]).astype(np.float32)
    numbers = np.array([world.noise.sigma, world.noise.outlier], np.float32)
    order = np.argsort(np.diff(layers.start), kind="stable")
    gains = np.zeros(len(order))
    for first in range(0, len(order), TOGETHER):
        part = order[first : first + TOGETHER]
        some = layers.of(part)
        pixel, depth, shade, face = _filled(some, beyond)
        lit = np.moveaxis(face_colours[face], -1, 0) * shade
        prior = _prior(world, some.kinds, pixel.shape[1])
        gains[part] = np.asarray(_log_gains(*arrays, pixel, depth, lit, prior, numbers, clipped=clipped))[
            : len(part)
        ]
    return gains


def _prior(world: TableWorld, kinds: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    """Mean and standard deviation (2, count) of albedos, or near enough of gains."""
    prior = np.full((2, count), 1.0, np.float32)
    prior[:, : len(kinds)] = np.where(
        world.is_coloured[kinds],
        [[1.0], [world.noise.gain_sd]],
        [[world.noise.albedo_mean], [world.noise.albedo_sd]],
    )
    return prior


def _filled(layers: Layers, beyond: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Pixel, depth, shade and triangle (P, B') of each thing, filled up with a pixel beyond the image."""
    counts = np.diff(layers.start)
    things, pixels = len(counts), int(counts.max(initial=1))
    shape = 1 << (max(things, LEAST_THINGS) - 1).bit_length(), -(-pixels // PIXELS) * PIXELS
    pixel, depth, shade, face = (
        np.zeros(shape, kind) for kind in (np.int32, np.float32, np.float32, np.int32)
    )
    pixel[:] = beyond
    there = np.arange(shape[1]) < counts[:, None]
    rows = (pixel, layers.pixel), (depth, layers.depth_m), (shade, layers.shade), (face, layers.face)
    for part, values in rows:
        part[:things][there] = values
    return pixel.T, depth.T, shade.T, face.T


@partial(jax.jit, static_argnames="clipped")
def _log_gains(
    colour: jax.Array,
    explained: jax.Array,
    rest_m: jax.Array,
    pixel: jax.Array,
    depth_m: jax.Array,
    lit: jax.Array,
    prior: jax.Array,
    noise: jax.Array,
    clipped: bool,
) -> jax.Array:
    (sigma, outlier), (mean, sd) = noise, prior[:, None, None]
    seen = (depth_m < rest_m[pixel])[None]  # (1, P, B); lit (1, P, B) or (C, P, B), albedos (C, 1, B)
    observed = colour[:, pixel]  # (C, P, B)
    told = seen & jnp.isfinite(observed)
    value = jnp.where(told, observed, 0.0)
    albedo = _voted(jnp.where(jnp.isfinite(observed), observed, observed > 0), seen, lit)
    shown = jnp.any(seen, axis=1, keepdims=True)
    albedo = jnp.where(shown, albedo, mean)
    precision = jnp.zeros_like(albedo) + sd**-2
    peak = (1 - outlier) / (sigma * jnp.sqrt(2 * jnp.pi))
    for _ in range(FITS):
        inlier = told * peak * jnp.exp(-0.5 * ((value - lit * albedo) / sigma) ** 2)
        weight = inlier / (inlier + outlier) * (lit / sigma**2)
        precision = sd**-2 + jnp.sum(weight * lit, axis=1, keepdims=True)
        albedo = (mean * sd**-2 + jnp.sum(weight * value, axis=1, keepdims=True)) / precision
    rendered = lit * albedo
    density = peak * jnp.exp(-0.5 * ((value - rendered) / sigma) ** 2)
    density = density + outlier * ((value >= 0) & (value <= 1))
    if clipped:
        past = ndtr(jnp.where(observed > 0, rendered - 1, -rendered) / sigma)
        density = jnp.where(jnp.isinf(observed), (1 - outlier) * past + outlier / STORED, density)
    own = jnp.sum(jnp.log(jnp.maximum(density, LEAST)), axis=0) - explained[pixel]
    log_prior = -0.5 * ((albedo - mean) / sd) ** 2 - jnp.log(sd * jnp.sqrt(precision))
    return jnp.sum(jnp.where(seen[0], own, 0.0), axis=0) + jnp.sum(
        jnp.where(shown, log_prior, 0.0), axis=(0, 1)
    )


def _voted(colour: jax.Array, seen: jax.Array, lit: jax.Array) -> jax.Array:
    """The albedo (C, 1, B) for which most pixels vote; as `scene.colour.density` does."""
    ratio = colour / jnp.maximum(lit, 1e-3)
    cell = jnp.clip(jnp.floor(ratio / BIN).astype(jnp.int32) + CELLS // 4, 0, CELLS - 1)
    cell = jnp.where(seen, cell, CELLS)
    votes = jax.lax.map(lambda one: jnp.sum(cell == one, axis=1, keepdims=True), jnp.arange(-1, CELLS + 1))
    votes = votes.at[-1].set(0)
    best = jnp.argmax(votes[:-2] + 2 * votes[1:-1] + votes[2:], axis=0)
    return (best - CELLS // 4 + 0.5) * BIN
