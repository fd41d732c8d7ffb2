"""Gains of many things at once, compiled: Laplace's evidence of their pixels, less as these are explained.

Float32: for searching. What is reported is weighed by `posterior`. Things are the last axis of all arrays,
along which a processor works on several at once.
"""

from __future__ import annotations

from dataclasses import astuple
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from numpy.typing import NDArray

from scene.colour.density import BIN, CELLS, LEAST, STORED, ColourNoise
from scene.colour.world import Layers

FITS = 3
"""Steps of expectation and maximisation after the vote; two more change evidences by 0.05 nats."""
TOGETHER = 64
"""Things of a batch, of like numbers of pixels: their arrays stay in a core's cache."""
LEAST_THINGS, PIXELS = 8, 64
"""Batches are filled up, to a power of two and to a multiple: a dozen shapes to compile in all."""


def log_gains(
    colour: NDArray[np.float64],
    explained: NDArray[np.float64],
    depth_m: NDArray[np.float64],
    layers: Layers,
    noise: ColourNoise,
) -> NDArray[np.float64]:
    """What each of B things alone would add to the log evidence, (B,).

    Args:
        colour: (H * W, C) of the image; +inf or -inf where it was clipped.
        explained: (H * W,) log density of each pixel as it is explained without the thing.
        depth_m: (H * W,) of what stands there already, +inf over the table.
        layers: of the things.
        noise: of the colours.
    """
    beyond = len(colour)
    arrays = (
        np.pad(colour.T, ((0, 0), (0, 1))).astype(np.float32),
        np.append(explained, 0.0).astype(np.float32),
        np.append(depth_m, -np.inf).astype(np.float32),
    )
    clipped = bool(np.isinf(colour).any())
    numbers = np.array(astuple(noise), np.float32)
    order = np.argsort(np.diff(layers.start), kind="stable")
    gains = np.zeros(len(order))
    for first in range(0, len(order), TOGETHER):
        part = order[first : first + TOGETHER]
        filled = _filled(layers.of(part), beyond)
        gains[part] = np.asarray(_log_gains(*arrays, *filled, numbers, clipped=clipped))[: len(part)]
    return gains


def _filled(layers: Layers, beyond: int) -> tuple[NDArray, NDArray, NDArray]:
    """Pixel, depth and shade (P, B') of each thing, filled up with a pixel beyond the image."""
    counts = np.diff(layers.start)
    things, pixels = len(counts), int(counts.max(initial=1))
    shape = 1 << (max(things, LEAST_THINGS) - 1).bit_length(), -(-pixels // PIXELS) * PIXELS
    rows = np.full(shape, beyond, np.int32), np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    there = np.arange(shape[1]) < counts[:, None]
    for part, values in zip(rows, (layers.pixel, layers.depth_m, layers.shade), strict=True):
        part[:things][there] = values
    return rows[0].T, rows[1].T, rows[2].T


@partial(jax.jit, static_argnames="clipped")
def _log_gains(
    colour: jax.Array,
    explained: jax.Array,
    rest_m: jax.Array,
    pixel: jax.Array,
    depth_m: jax.Array,
    shade: jax.Array,
    noise: jax.Array,
    clipped: bool,
) -> jax.Array:
    sigma, outlier, mean, sd = noise
    seen = (depth_m < rest_m[pixel])[None]  # (1, P, B), as the shades; albedos (C, 1, B)
    shade = shade[None]
    observed = colour[:, pixel]  # (C, P, B)
    told = seen & jnp.isfinite(observed)
    value = jnp.where(told, observed, 0.0)
    albedo = _voted(jnp.where(jnp.isfinite(observed), observed, observed > 0), seen, shade)
    shown = jnp.any(seen, axis=1, keepdims=True)
    albedo = jnp.where(shown, albedo, mean)
    precision = jnp.full_like(albedo, sd**-2)
    peak = (1 - outlier) / (sigma * jnp.sqrt(2 * jnp.pi))
    for _ in range(FITS):
        inlier = told * peak * jnp.exp(-0.5 * ((value - shade * albedo) / sigma) ** 2)
        weight = inlier / (inlier + outlier) * (shade / sigma**2)
        precision = sd**-2 + jnp.sum(weight * shade, axis=1, keepdims=True)
        albedo = (mean * sd**-2 + jnp.sum(weight * value, axis=1, keepdims=True)) / precision
    rendered = shade * albedo
    density = peak * jnp.exp(-0.5 * ((value - rendered) / sigma) ** 2)
    density = density + outlier * ((value >= 0) & (value <= 1))
    if clipped:
        past = ndtr(jnp.where(observed > 0, rendered - 1, -rendered) / sigma)
        density = jnp.where(jnp.isinf(observed), (1 - outlier) * past + outlier / STORED, density)
    own = jnp.sum(jnp.log(jnp.maximum(density, LEAST)), axis=0) - explained[pixel]
    prior = -0.5 * ((albedo - mean) / sd) ** 2 - jnp.log(sd * jnp.sqrt(precision))
    return jnp.sum(jnp.where(seen[0], own, 0.0), axis=0) + jnp.sum(jnp.where(shown, prior, 0.0), axis=(0, 1))


def _voted(colour: jax.Array, seen: jax.Array, shade: jax.Array) -> jax.Array:
    """The albedo (C, 1, B) for which most pixels vote; as `scene.colour.density` does."""
    ratio = colour / jnp.maximum(shade, 1e-3)
    cell = jnp.clip(jnp.floor(ratio / BIN).astype(jnp.int32) + CELLS // 4, 0, CELLS - 1)
    cell = jnp.where(seen, cell, CELLS)
    votes = jax.lax.map(lambda one: jnp.sum(cell == one, axis=1, keepdims=True), jnp.arange(-1, CELLS + 1))
    votes = votes.at[-1].set(0)
    best = jnp.argmax(votes[:-2] + 2 * votes[1:-1] + votes[2:], axis=0)
    return (best - CELLS // 4 + 0.5) * BIN
