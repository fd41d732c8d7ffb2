"""What a pixel shows of things that nobody asked for: a smooth surface, foretold by the pixels before it.

In raster order every pixel has the mixture

    u(z) = sum_k w_k Normal(z; m_k, s_k) + w_0 1[0 <= z <= R] / R

over predictions m_k from the measured pixels to the left and above: the plane through those near by that lie
on one surface with the left one, with that above or with the first to its right that lies on another surface,
without which outlines that lean to the left would be new in every row; the left one and that above alone; and
their sum less the corner between them, which foretells errors that hang together. The remaining weight is
that of a surface that begins here. Where an earlier frame of the same scene has measured what is there, its
depth is one more prediction (`scene.likelihood.earlier_frames`). On a plane inverse depth is linear in the
pixel's place, so that planes are fitted in inverse depth. Weights and the scales s_k are those of the sensor,
at the distance from one compared pixel to the next: they come with its profile, or are learned from images by
expectation maximisation (docs/model.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import erf
from numpy.typing import NDArray

from recordings.sensor_profile import UNKNOWN_KINDS, UNKNOWN_PARTS, UnknownTable
from recordings.types import NO_RETURN, DepthNoise
from scene.likelihood.causal_planes import LEANING_PX, fitted, shifted, shifts, wide_slopes
from shapes.depth_noise import standard_deviation
from shapes.stored_kernels import jit_stored

REACH_M = 2.5
"""R: a surface that begins anywhere is as near as what may show an object, `FARTHEST_M` of the foreground."""
JOINED_M = 0.02
"""Neighbours that differ more are of two surfaces: no plane goes through them."""
FARTHEST_M = 20.0
"""Planes that predict more predict nothing."""
FIRST_SCALES = (1.2, 1.2, 4.0, 4.0, 12.0, 1.2, 1.2)
"""Of the predictions, in standard deviations of the sensor, before they are learned."""
ITERATIONS = 20
MOST_PIXELS = 200_000
"""From which weights are learned: of more every n-th will do, they are a hundred numbers."""
LEAST_WEIGHT, LEAST_SCALE = 1e-3, 0.3
"""A mixture that is learned keeps so much of each part: an image of one wall knows no edge."""
NO_EDGE, LEANING, EDGES = 0, 4, 6
"""Edges that run towards a pixel: none, one along the row, along the column, both; none of these but one that
leans to the left by more than a column a row; the last where a pixel before is not measured."""
KINDS = 2 * EDGES
"""Of weights: first those of calm pixels, then those where a pixel before was badly foretold."""
SURPRISE = 3.0
"""Standard deviations of the sensor that a prediction errs by in one of a hundred or so calm pixels."""
LIKE_ALL = 20.0
"""Pixels' worth of what is learned of all pixels in what is learned of those with an edge of one kind."""
PREDICTIONS = (0, 1, 4, 6), (2,), (3,), (5,), (len(FIRST_SCALES),)
"""Those that look at the pixels to the left and above, at the left one alone, at that above alone, at the one
to the right of that; where there is one, at an earlier frame."""
EITHER = 4
"""The one that is there wherever one of both neighbours is, and tells of surprises."""
assert (KINDS, len(FIRST_SCALES) + 1) == (UNKNOWN_KINDS, UNKNOWN_PARTS)  # of sensor profiles


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EarlierWeights:
    """How well earlier frames foretell the frames of a scene.

    Where the pixels before foretell about the same depth, and where they do not.

    Attributes:
        weights: (2,).
        scales: (2,) standard deviations over that of the sensor.
    """

    weights: jax.Array | NDArray[np.float32]
    scales: jax.Array | NDArray[np.float32]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UnknownWeights:
    """What is learned of a sensor.

    Attributes:
        weights: (KINDS, K + 1) that sum to 1; the last is w_0.
        scales: (K,) standard deviations of predictions over that of the sensor there.
        reach_m: R.
        earlier: of the frames at hand; None where there is but one.
    """

    weights: jax.Array
    scales: jax.Array
    reach_m: jax.Array | float = REACH_M
    earlier: EarlierWeights | None = None

    @classmethod
    def of(cls, table: UnknownTable, pitch_rad: float) -> UnknownWeights:
        """Those of a sensor's profile for pixels so far apart.

        Raises:
            ValueError: the profile does not know pixels so far apart.
        """
        weights, scales = (jax.device_put(part.astype(np.float32)) for part in table.at(pitch_rad))
        return cls(weights, scales, jax.device_put(np.float32(table.reach_m)))

    @classmethod
    def learned(cls, images_m: Sequence[NDArray[np.float32]], noise: DepthNoise) -> UnknownWeights:
        """Those under which images (H, W) of one sensor are most probable, by expectation maximisation.

        Of an edge's course only as far as the images have edges: else what is learned of all pixels counts.
        """
        there, errors, sensor_m, of_kind = _foretold(images_m, noise)
        count = errors.shape[1]
        possible = np.concatenate([there, np.ones((1, count))])
        scales = np.array(FIRST_SCALES)
        weights = np.full((KINDS, len(scales) + 1), 1 / (len(scales) + 1))
        for _ in range(ITERATIONS if count else 0):
            wide = scales[:, None]
            parts = there * np.exp(-0.5 * (errors / wide) ** 2) / (np.sqrt(2 * np.pi) * wide * sensor_m)
            joint = (of_kind @ weights).T * np.concatenate([parts, np.full((1, count), 1 / REACH_M)])
            shares = joint / joint.sum(axis=0)
            anywhere = shares.sum(axis=1) / possible.sum(axis=1).clip(1)
            anywhere = np.maximum(anywhere, LEAST_WEIGHT)
            anywhere /= anywhere.sum()
            weights = (of_kind.T @ shares.T + LIKE_ALL * anywhere) / (of_kind.T @ possible.T + LIKE_ALL)
            weights = np.maximum(weights, LEAST_WEIGHT)
            weights /= weights.sum(axis=1, keepdims=True)
            squares = (shares[:-1] * errors**2).sum(axis=1) / shares[:-1].sum(axis=1).clip(1e-9)
            scales = np.sqrt(squares).clip(LEAST_SCALE)
        return cls(*(jax.device_put(part.astype(np.float32)) for part in (weights, scales)))


def _foretold(images_m: Sequence[NDArray[np.float32]], noise: DepthNoise) -> tuple[NDArray[np.float64], ...]:
    """How the measured pixels (n,) of all images are foretold.

    Returns:
        Which predictions there are (K, n); their errors in standard deviations of the sensor (K, n); these in
        metres (K, n); which weights count (n, KINDS).
    """
    parts = []
    step = -(-sum(image.size for image in images_m) // MOST_PIXELS)
    for depth_m in images_m:
        *predictions, kinds = _foreseen(depth_m, noise)
        means_m, known = (np.asarray(part, np.float64) for part in predictions)
        told = (depth_m != NO_RETURN) & (depth_m <= REACH_M) & (known > 0).any(axis=0)
        told &= (np.arange(told.size) % step == 0).reshape(told.shape)
        sensor_m = np.asarray(standard_deviation(noise, means_m))[:, told]
        errors = (depth_m - means_m)[:, told] / sensor_m
        parts.append((known[:, told], errors, sensor_m, np.eye(KINDS)[np.asarray(kinds)[told]].T))
    there, errors, sensor_m, of_kind = (np.concatenate(leaves, axis=1) for leaves in zip(*parts, strict=True))
    return there, errors, sensor_m, of_kind.T


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class UnknownSurfaces:
    """The mixtures of all pixels of an image.

    Attributes:
        means_m: (K, H, W) predicted depths, with one more, the last, where an earlier frame predicts.
        sigmas_m: (K, H, W).
        weights: (K + 1, H, W) that sum to 1; the last is w_0.
        columns: (H, W) int32, how far to the right in the row above the upper right neighbour is.
        reach_m: R.
    """

    means_m: jax.Array
    sigmas_m: jax.Array
    weights: jax.Array
    columns: jax.Array
    reach_m: jax.Array | float

    @classmethod
    def of(
        cls,
        depth_m: jax.Array,
        noise: DepthNoise,
        learned: UnknownWeights,
        earlier_m: jax.Array | None = None,
    ) -> UnknownSurfaces:
        """The mixtures of an image (H, W), given what an earlier frame, if any, has measured (H, W)."""
        means_m, known = _predictions(depth_m, noise)
        weights = jnp.moveaxis(learned.weights[_kinds(depth_m, means_m, known, noise)], -1, 0)
        shares = weights * jnp.concatenate([known, jnp.ones_like(known[:1])])
        sigmas_m = learned.scales[:, None, None] * standard_deviation(noise, means_m)
        shares = shares / jnp.sum(shares, axis=0, keepdims=True)
        alone = cls(means_m, sigmas_m, shares, _upper_right(depth_m)[1], learned.reach_m)
        if earlier_m is None or learned.earlier is None:
            return alone
        return alone._given(earlier_m, known[EITHER] > 0, noise, learned.earlier)

    def _given(
        self, earlier_m: jax.Array, known: jax.Array, noise: DepthNoise, learned: EarlierWeights
    ) -> UnknownSurfaces:
        """The same given what an earlier frame has measured (H, W).

        Args:
            earlier_m: `NO_RETURN` where it has nothing.
            known: (H, W) where pixels before foretell anything.
            noise: of the sensor.
            learned: how well the frame foretells this one.
        """
        foretold_m, differs = told_otherwise(earlier_m, self.means_m[EITHER], known, noise)
        weight, scale = (jnp.asarray(part)[differs] for part in (learned.weights, learned.scales))
        told = (weight * (earlier_m != NO_RETURN))[None]
        shares = (1 - told) * self.weights
        spread_m = scale * standard_deviation(noise, foretold_m)
        return replace(
            self,
            means_m=jnp.concatenate([self.means_m, foretold_m[None]]),
            sigmas_m=jnp.concatenate([self.sigmas_m, spread_m[None]]),
            weights=jnp.concatenate([shares[:-1], told, shares[-1:]]),
        )

    def density_parts(self, observed_m: jax.Array) -> list[jax.Array]:
        """Densities (...) at observed depths of what is foretold, as `PREDICTIONS` has it."""
        foretold = zip(self.means_m, self.sigmas_m, strict=True)
        return self._by_neighbours([normal_density(observed_m, *of_mean) for of_mean in foretold])

    def shares(self) -> list[jax.Array]:
        """Weights (...) of what is foretold, likewise."""
        return self._by_neighbours([1.0] * len(self.means_m))

    def new_density(self, observed_m: jax.Array) -> jax.Array:
        """Density (...) at the observed depths of a surface that begins here."""
        return ((observed_m >= 0) & (observed_m <= self.reach_m)) / self.reach_m

    def drawn(self, key: jax.Array, weights: Sequence[jax.Array]) -> jax.Array:
        """Depths (...) drawn with weights (...) of what is foretold and, last, of what begins here."""
        new_key, kind_key, key = jax.random.split(key, 3)
        of_parts = {one: group for group, members in enumerate(PREDICTIONS) for one in members}
        kept = jnp.stack([weights[of_parts[one]] for one in range(len(self.means_m))])
        foretold = drawn_normal(key, self.weights[:-1] * kept, self.means_m, self.sigmas_m)
        is_new = jax.random.uniform(kind_key, foretold.shape) < weights[-1]
        return jnp.where(is_new, self.reach_m * jax.random.uniform(new_key, foretold.shape), foretold)

    def parts_before(self, depth_m: jax.Array, sigma_m: jax.Array) -> list[jax.Array]:
        """Probabilities (...) that what is foretold is nearer than a surface so well known, likewise."""
        foretold = zip(self.means_m, self.sigmas_m, strict=True)
        distances = [(depth_m - mean_m) / jnp.hypot(of_mean_m, sigma_m) for mean_m, of_mean_m in foretold]
        return self._by_neighbours(list(map(normal_distribution, distances)))

    def new_before(self, depth_m: jax.Array, sigma_m: jax.Array) -> jax.Array:
        """The same (...) of a surface that begins here: the mean of Phi((d - z) / s) over 0 <= z <= R."""
        low, high = (_ramp((depth_m - end) / sigma_m) for end in (0.0, self.reach_m))
        return sigma_m / self.reach_m * (low - high)

    def _by_neighbours(self, parts: Sequence[jax.Array | float]) -> list[jax.Array]:
        """Weighted sums (...) of predictions (...), as `PREDICTIONS` has them.

        A list, for kernels that write to one array of several parts are scalar, and slow.
        """
        weighted = [weight * part for weight, part in zip(self.weights[:-1], parts, strict=True)]
        groups = (group for group in PREDICTIONS if group[-1] < len(weighted))
        return [jnp.asarray(sum(weighted[part] for part in group)) for group in groups]


def kept_parts(left: jax.Array, above: jax.Array, right: jax.Array) -> list[jax.Array]:
    """Four shares (...) that count of what both neighbours, the left, the upper, the upper right foretell.

    An unknown surface does not continue an object's: what a neighbour foretells that shows an object, with
    probability (...), is left out, and a surface that begins here gets its weight.
    """
    return [(1 - left) * (1 - above), 1 - left, 1 - above, 1 - right]


def _kinds(depth_m: jax.Array, means_m: jax.Array, known: jax.Array, noise: DepthNoise) -> jax.Array:
    """Which weights each pixel (H, W) has: by the edge that runs towards it, and by surprise before it.

    Where the pixel to the left differs from that above it, an edge runs along the rows, and is likely to go
    on. So is a crease, at which predictions fail.
    """
    left, above, corner = shifted(depth_m, 0, 1), shifted(depth_m, 1, 0), shifted(depth_m, 1, 1)
    along_row, along_column = (jnp.abs(near - corner) >= JOINED_M for near in (left, above))
    leans = ~along_row & ~along_column & (_upper_right(depth_m)[1] > 1)
    measured = (left != NO_RETURN) & (above != NO_RETURN) & (corner != NO_RETURN)
    edge = jnp.where(leans, LEANING, NO_EDGE + along_row + 2 * along_column)
    edge = jnp.where(measured, edge, EDGES - 1)
    told = (depth_m != NO_RETURN) & (known[EITHER] > 0)
    error_m = jnp.where(told, depth_m - means_m[EITHER], 0.0)
    large = is_surprising(error_m, standard_deviation(noise, means_m[EITHER])).astype(error_m.dtype)
    surprised = (shifted(large, 0, 1) > 0) | (shifted(large, 1, 0) > 0)
    return edge + EDGES * surprised.astype(jnp.int32)


def told_otherwise(
    earlier_m: jax.Array, foretold_m: jax.Array, known: jax.Array | bool, noise: DepthNoise
) -> tuple[jax.Array, jax.Array]:
    """Depths (...) of an earlier frame, 1 where it has none; 1 where pixels before foretell another, else 0.

    Args:
        earlier_m: (...) `NO_RETURN` where the frame has none.
        foretold_m: (...) what the pixels before foretell.
        known: where they foretell anything.
        noise: of the sensor.
    """
    seen_m = jnp.where(earlier_m == NO_RETURN, 1.0, earlier_m)
    near = known & ~is_surprising(foretold_m - seen_m, standard_deviation(noise, seen_m))
    return seen_m, 1 - near.astype(jnp.int32)


def is_surprising(error_m: jax.Array, sensor_m: jax.Array) -> jax.Array:
    """Whether predictions erred by far more than a sensor of this standard deviation does; any shape."""
    return jnp.abs(error_m) > SURPRISE * sensor_m


@jit_stored()
def _foreseen(depth_m: jax.Array, noise: DepthNoise) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`_predictions` of an image (H, W), and its `_kinds`."""
    means_m, known = _predictions(depth_m, noise)
    return means_m, known, _kinds(depth_m, means_m, known, noise)


def _predictions(depth_m: jax.Array, noise: DepthNoise) -> tuple[jax.Array, jax.Array]:
    """Predicted depths (K, H, W), and 1 where there are such (K, H, W)."""
    left, above, corner = (shifted(depth_m, *by) for by in ((0, 1), (1, 0), (1, 1)))
    on_left, (rise, _) = _plane(depth_m, left, noise)
    on_above, (_, fall) = _plane(depth_m, above, noise)
    on_right, _ = _plane(depth_m, _upper_right(depth_m)[0], noise)
    either = jnp.where(left != NO_RETURN, on_left, on_above)
    ends = _farther(left, rise), _farther(above, fall)
    means_m = jnp.stack([on_left, on_above, *ends, either, on_right, _three(left, above, corner)])
    known = means_m != NO_RETURN
    return jnp.where(known, means_m, 1.0), known.astype(depth_m.dtype)


def _upper_right(depth_m: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Depth (H, W) of the upper right neighbour of each pixel, and by how many columns (H, W) it is aside.

    The first measured one in the row above that lies on another surface than the one above, else the next.
    """
    near = shifts(depth_m)
    above_m, right_m = near(1, 0), near(1, -1)
    columns, found = jnp.ones(depth_m.shape, jnp.int32), jnp.zeros(depth_m.shape, bool)
    for across in range(1, LEANING_PX + 1):
        here_m = near(1, -across)
        begins = ~found & (here_m != NO_RETURN) & (jnp.abs(here_m - above_m) >= JOINED_M)
        right_m, columns = jnp.where(begins, here_m, right_m), jnp.where(begins, across, columns)
        found |= begins
    return right_m, columns


def _plane(
    depth_m: jax.Array, base_m: jax.Array, noise: DepthNoise
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    """Depth (H, W) of the plane through the pixels before each that lie on the surface of `base_m` (H, W).

    `NO_RETURN` where that was not measured. The plane errs from a wider one as a surface of the scene errs
    from its shape, so that a plane of which much was seen is known as well as that shape; the wider one's
    slopes in inverse depth (2) (H, W) along row and column.
    """
    known = base_m != NO_RETURN
    base = 1 / jnp.where(known, base_m, 1.0)

    def rise(near_m: jax.Array) -> tuple[jax.Array, jax.Array]:
        measured = near_m != NO_RETURN
        use = measured & (jnp.abs(near_m - base_m) < JOINED_M)
        return 1 / jnp.where(measured, near_m, 1.0) - base, use.astype(depth_m.dtype)

    near = shifts(depth_m)
    first = fitted(lambda *by: rise(near(*by)))
    wide_x, wide_y = wide_slopes(depth_m, base, first, standard_deviation(noise, base_m) * base**2)

    def beside(down: int, across: int) -> tuple[jax.Array, jax.Array]:
        value, use = rise(near(down, across))
        return value + across * wide_x + down * wide_y, use

    here = base + fitted(beside)[0]
    return _depth(here, known), (wide_x, wide_y)


def _three(left_m: jax.Array, above_m: jax.Array, corner_m: jax.Array) -> jax.Array:
    """Depth (H, W) of the plane through three neighbours (H, W), `NO_RETURN` where one was not measured."""
    known = (left_m != NO_RETURN) & (above_m != NO_RETURN) & (corner_m != NO_RETURN)
    left, above, corner = (1 / jnp.where(known, one, 1.0) for one in (left_m, above_m, corner_m))
    return _depth(left + above - corner, known)


def _farther(near_m: jax.Array, slope: jax.Array) -> jax.Array:
    """Depth (H, W) one pixel on from depths (H, W), `NO_RETURN` where these are."""
    known = near_m != NO_RETURN
    return _depth(1 / jnp.where(known, near_m, 1.0) + slope, known)


def _depth(inverse: jax.Array, known: jax.Array) -> jax.Array:
    """Depth (H, W) of inverse depths, `NO_RETURN` where they are not known or no camera sees."""
    return jnp.where(known & (inverse > 1 / FARTHEST_M), 1 / jnp.maximum(inverse, 1 / FARTHEST_M), NO_RETURN)


def drawn_normal(key: jax.Array, weights: jax.Array, means: jax.Array, sigmas: jax.Array) -> jax.Array:
    """Draws (H, W) of mixtures of normals (K, H, W); weights need not sum to 1."""
    part_key, key = jax.random.split(key)
    part = jax.random.categorical(part_key, jnp.log(weights), axis=0)[None]
    mean, sigma = (jnp.take_along_axis(leaf, part, axis=0)[0] for leaf in (means, sigmas))
    return mean + sigma * jax.random.normal(key, mean.shape, mean.dtype)


def normal_distribution(x: jax.Array) -> jax.Array:
    """Phi, to rounding of 1: `ndtr` minds the tails, and takes five times as long."""
    return 0.5 * (1 + erf(x * math.sqrt(0.5)))


def normal_density(value: jax.Array, mean: jax.Array, sigma: jax.Array) -> jax.Array:
    """Density at a value, Lebesgue measure; arrays that broadcast."""
    return jnp.exp(-0.5 * ((value - mean) / sigma) ** 2) / (sigma * jnp.sqrt(2 * jnp.pi))


def _ramp(x: jax.Array) -> jax.Array:
    """The integral of Phi up to x."""
    return x * normal_distribution(x) + jnp.exp(-0.5 * x**2) / jnp.sqrt(2 * jnp.pi)
