"""What a pixel shows of things that nobody asked for: a smooth surface, foretold by the pixels before it.

In raster order every pixel has the mixture

    u(z) = sum_k w_k Normal(z; m_k, s_k) + w_0 1[0 <= z <= R] / R

over predictions m_k from the measured pixels to the left and above: the plane through those near by that lie
on one surface with the left one or with that above, and these two alone. The remaining weight is that of a
surface that begins here. On a plane inverse depth is linear in the pixel's place, so that planes are fitted
in inverse depth. Weights and the scales s_k are learned from the image itself by expectation maximisation:
they are those of its sensor, at the distance from one compared pixel to the next (docs/model.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise
from shapes.depth_noise import standard_deviation

REACH_M = 2.5
"""R: a surface that begins anywhere is as near as what may show an object, `FARTHEST_M` of the foreground."""
JOINED_M = 0.02
"""Neighbours that differ more are of two surfaces: no plane goes through them."""
FARTHEST_M = 20.0
"""Planes that predict more predict nothing."""
FIRST_SCALES = (1.2, 1.2, 4.0, 4.0, 12.0)
"""Of the predictions, in standard deviations of the sensor, before they are learned."""
ITERATIONS = 20
LEAST_WEIGHT, LEAST_SCALE = 1e-3, 0.3
"""A mixture that is learned keeps so much of each part: an image of one wall knows no edge."""
USES_LEFT, USES_ABOVE = (1, 1, 1, 0, 1), (1, 1, 0, 1, 1)
"""Which predictions look at the pixel to the left and at that above."""
ROWS_BEFORE, COLUMNS_BESIDE = 2, 2
"""The pixels before one to which planes are fitted: so many rows above, so many columns to either side."""
STIFFNESS, LEAST_COUNT = 0.5, 1e-3
"""Added to the normal equations of slopes, in pixels squared, and the least weight of all: few pixels tell
of no slope."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UnknownWeights:
    """What is learned of a sensor.

    Attributes:
        weights: (K + 1,) that sum to 1; the last is w_0.
        scales: (K,) standard deviations of predictions over that of the sensor there.
        reach_m: R.
    """

    weights: jax.Array
    scales: jax.Array
    reach_m: jax.Array | float = REACH_M

    @classmethod
    def learned(cls, depth_m: NDArray[np.float32], noise: DepthNoise) -> UnknownWeights:
        """Those under which an image (H, W) is most probable, by expectation maximisation."""
        means_m, known = (np.asarray(part, np.float64) for part in _predictions(jnp.asarray(depth_m)))
        told = (depth_m != NO_RETURN) & (depth_m <= REACH_M) & (known > 0).any(axis=0)
        there, sensor_m = known[:, told] > 0, np.asarray(standard_deviation(noise, means_m))[:, told]
        errors = (depth_m - means_m)[:, told] / sensor_m
        seldom = np.append(there.sum(axis=1), told.sum()).clip(1)
        scales = np.array(FIRST_SCALES)
        weights = np.full(len(scales) + 1, 1 / (len(scales) + 1))
        for _ in range(ITERATIONS if told.any() else 0):
            wide = scales[:, None]
            parts = there * np.exp(-0.5 * (errors / wide) ** 2) / (np.sqrt(2 * np.pi) * wide * sensor_m)
            joint = weights[:, None] * np.concatenate([parts, np.full((1, told.sum()), 1 / REACH_M)])
            shares = joint / joint.sum(axis=0)
            weights = np.maximum(shares.sum(axis=1) / seldom, LEAST_WEIGHT)
            weights /= weights.sum()
            squares = (shares[:-1] * errors**2).sum(axis=1) / shares[:-1].sum(axis=1).clip(1e-9)
            scales = np.sqrt(squares).clip(LEAST_SCALE)
        return cls(*(jax.device_put(part.astype(np.float32)) for part in (weights, scales)))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UnknownSurfaces:
    """The mixtures of all pixels of an image.

    Attributes:
        means_m: (K, H, W) predicted depths.
        sigmas_m: (K, H, W).
        weights: (K + 1, H, W) that sum to 1; the last is w_0.
        reach_m: R.
    """

    means_m: jax.Array
    sigmas_m: jax.Array
    weights: jax.Array
    reach_m: jax.Array | float

    @classmethod
    def of(cls, depth_m: jax.Array, noise: DepthNoise, learned: UnknownWeights) -> UnknownSurfaces:
        """The mixtures of an image (H, W)."""
        means_m, known = _predictions(depth_m)
        parts = learned.weights[:-1, None, None] * known
        begins = jnp.broadcast_to(learned.weights[-1], depth_m.shape)[None]
        shares = jnp.concatenate([parts, begins])
        sigmas_m = learned.scales[:, None, None] * standard_deviation(noise, means_m)
        return cls(means_m, sigmas_m, shares / jnp.sum(shares, axis=0, keepdims=True), learned.reach_m)

    def not_continuing(self, left: jax.Array, above: jax.Array) -> UnknownSurfaces:
        """The mixtures where the neighbours show objects with probabilities (H, W).

        An unknown surface does not continue an object's: what such a neighbour foretells goes to w_0.
        """
        keeps = [
            (1 - left if by_left else 1.0) * (1 - above if by_above else 1.0)
            for by_left, by_above in zip(USES_LEFT, USES_ABOVE, strict=True)
        ]
        kept = jnp.stack([weight * share for weight, share in zip(self.weights, keeps, strict=False)])
        return replace(self, weights=jnp.concatenate([kept, 1 - jnp.sum(kept, axis=0, keepdims=True)]))

    def density(self, observed_m: jax.Array) -> jax.Array:
        """U (H, W) at the observed depths; without meaning where nothing was measured."""
        by_part = _normal(observed_m[None], self.means_m, self.sigmas_m)
        inside = (observed_m >= 0) & (observed_m <= self.reach_m)
        return jnp.sum(self.weights[:-1] * by_part, axis=0) + self.weights[-1] * inside / self.reach_m

    def share_before(self, depth_m: jax.Array, sigma_m: jax.Array) -> jax.Array:
        """Probability (H, W) that the surface is nearer than another one, known to `sigma_m`."""
        by_part = ndtr((depth_m[None] - self.means_m) / jnp.hypot(self.sigmas_m, sigma_m[None]))
        # the mean of Phi((d - z) / s) over 0 <= z <= R
        low, high = (_ramp((depth_m - end) / sigma_m) for end in (0.0, self.reach_m))
        new = sigma_m / self.reach_m * (low - high)
        return jnp.sum(self.weights[:-1] * by_part, axis=0) + self.weights[-1] * new


def _predictions(depth_m: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Predicted depths (K, H, W), and 1 where there are such (K, H, W)."""
    left, above = shifted(depth_m, 0, 1), shifted(depth_m, 1, 0)
    on_left, on_above = _plane(depth_m, left), _plane(depth_m, above)
    either = jnp.where(left != NO_RETURN, on_left, on_above)
    means_m = jnp.stack([on_left, on_above, left, above, either])
    known = means_m != NO_RETURN
    return jnp.where(known, means_m, 1.0), known.astype(depth_m.dtype)


def _plane(depth_m: jax.Array, base_m: jax.Array) -> jax.Array:
    """Depth (H, W) of the plane through the pixels before each that lie on the surface of `base_m` (H, W).

    `NO_RETURN` where that was not measured.
    """
    known = base_m != NO_RETURN
    base = 1 / jnp.where(known, base_m, 1.0)

    def rise(near_m: jax.Array) -> tuple[jax.Array, jax.Array]:
        measured = near_m != NO_RETURN
        use = measured & (jnp.abs(near_m - base_m) < JOINED_M)
        return 1 / jnp.where(measured, near_m, 1.0) - base, use.astype(depth_m.dtype)

    here = base + extrapolated(lambda down, across: rise(shifted(depth_m, down, across)))
    return jnp.where(known & (here > 1 / FARTHEST_M), 1 / jnp.maximum(here, 1 / FARTHEST_M), NO_RETURN)


def extrapolated(before: Callable[[int, int], tuple[jax.Array, jax.Array]]) -> jax.Array:
    """Value (H, W) at every pixel of the least-squares plane through those before it; 0 without any.

    Args:
        before: values and weights (H, W) of the pixels so many rows above and columns to the left of each.
    """
    sums = [jnp.zeros(())] * 9
    for down in range(ROWS_BEFORE + 1):
        for across in range(1 if down == 0 else -COLUMNS_BESIDE, COLUMNS_BESIDE + 1):
            value, use = before(down, across)
            terms = (
                1.0,
                -across,
                -down,
                across**2,
                across * down,
                down**2,
                value,
                -across * value,
                -down * value,
            )
            sums = [total + use * term for total, term in zip(sums, terms, strict=True)]
    count, x, y, xx, xy, yy, d, xd, yd = sums
    n = jnp.maximum(count, LEAST_COUNT)
    xx, xy, yy = xx - x * x / n + STIFFNESS, xy - x * y / n, yy - y * y / n + STIFFNESS
    xd, yd = xd - x * d / n, yd - y * d / n
    determinant = xx * yy - xy**2
    slope_x, slope_y = (yy * xd - xy * yd) / determinant, (xx * yd - xy * xd) / determinant
    return (d - slope_x * x - slope_y * y) / n


def shifted(image: jax.Array, down: int, across: int) -> jax.Array:
    """The pixel so far above and to the left (or right) of each, `NO_RETURN` beyond the border."""
    height, width = image.shape
    right = max(-across, 0)
    wide = jnp.pad(image, ((down, 0), (max(across, 0), right)), constant_values=NO_RETURN)
    return wide[:height, right : right + width]


def _normal(value: jax.Array, mean: jax.Array, sigma: jax.Array) -> jax.Array:
    return jnp.exp(-0.5 * ((value - mean) / sigma) ** 2) / (sigma * jnp.sqrt(2 * jnp.pi))


def _ramp(x: jax.Array) -> jax.Array:
    """The integral of Phi up to x."""
    return x * ndtr(x) + jnp.exp(-0.5 * x**2) / jnp.sqrt(2 * jnp.pi)
