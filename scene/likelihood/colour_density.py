"""Density of a colour image given a scene and its depth image: one more factor, pixel by pixel.

Colours o are logs of light in three components (`scene.objects.surface_colour`), so that light and shade are
added to a surface's own colour m. In raster order, with q the probability, by the pixel's depth alone, that
it shows an object,

    p(o | scene, depth) = q t a(o) + (1 - q t) u(o)

u foretells a colour by the pixels to the left, above, and above to the right, whatever they show:

    u(o) = sum_k w_k Normal(o; o_k, s_k) + w_0 Normal(o; mean of the image, ANY_SD)

w and s are learned from the image by EM. a foretells the residual r = o - m as u foretells the colour, by the
same w and s, from those pixels before that show the object; where there is none, and in place of w_0, by what
is known of its light: a gain, Normal(0, GAIN_SD) before anything is seen, then what the pixels before leave
of it (a Kalman filter). Whether a pixel before shows the object in its own colours is told by its own depth
and colour: of what has others no light is learned. Errors of neighbouring pixels are alike, so that a flat
thing is judged by its colour once and not at every pixel, and a texture by its edges. t is the probability
that the colours are right here, by whether the pixels before agree: textures are wrong in pieces. With WRONG
the whole thing has other colours than its model's, which is paid for once. A scene's factor over u's is a
product over the pixels that its objects cover (docs/model.md, section L3).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from scene.execution import FAST_COMPILE
from scene.likelihood.causal_planes import shifts
from scene.likelihood.pixel_factors import CHANGES
from scene.objects.surface_colour import components_of_light
from scene.observation.pixel_window import PixelWindow

GAIN_SD = (0.7, 0.2, 0.2)
"""Of an object's light over that of its model, in logs: brightness by a factor of two either way (a lamp's
place and the shade of its faces), hue by a fifth, which a camera's white balance leaves."""
SURFACE_SD = (0.4, 0.1, 0.1)
"""Of a pixel's residual about its object's gain: faces are shaded differently, and lit by what is near."""
OUTLIERS = 0.02
"""Highlights and what is reflected: any colour of the image."""
WRONG = 0.01
"""Probability that colours are wrong where nothing was seen before; neighbours change as depths do."""
BEFORE = ((0, 1), (1, 0), (1, -1))
"""Rows above and columns to the left of the pixels by which one is foretold: whichever way the outline of a
thing slants, one of them shows the thing too, after its first pixel."""
FIRST_SCALES = (0.3, 1.5)
"""From which EM begins, over the standard deviation of differences between neighbours."""
ITERATIONS = 20
LEAST_WEIGHT, LEAST_SCALE = 1e-3, 0.02
"""A mixture that is learned keeps so much of each part; one step of 8 bits in the middle of the range is
0.017 of its light."""
ANY_SD = (1.2, 0.8, 0.8)
"""Of the colours of things about an image's mean: a saturated red of 8 bits is 2 of these from grey. An image
of a table tells little of what may stand on it."""
LEAST_DENSITY = 1e-30
"""Of a colour that is nothing like the image's, in place of zero."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ColourDensity:
    """The colours of a window, ready for scenes.

    Attributes:
        observed: (H, W, 3).
        known: (H, W) bool.
        weights: (2 B + 1,) of each pixel of `BEFORE`, narrow and wide, and of a new surface; they sum to 1.
        scales: (2 B, 3).
        mean: (3,) of the image.
        log_unknown: (H, W) log u.
    """

    observed: jax.Array
    known: jax.Array
    weights: jax.Array
    scales: jax.Array
    mean: jax.Array
    log_unknown: jax.Array

    @classmethod
    def of(cls, observed: NDArray[np.floating], known: NDArray[np.bool_]) -> ColourDensity:
        """The density of an image of colours (H, W, 3), of which some pixels (H, W) are known."""
        mean = observed[known].mean(axis=0) if known.any() else np.zeros(3)
        colours = np.where(known[..., None], observed, 0.0).astype(np.float32)
        learned = *_learned(observed, known, mean), mean
        numbers = [part.astype(np.float32) for part in learned]
        arrays = [jax.device_put(part) for part in (colours, known, *numbers)]
        return cls(*arrays, log_unknown=_log_unknown(*arrays))

    def cut(self, first: tuple[jax.Array, jax.Array], shape: tuple[int, ...]) -> ColourDensity:
        """Of a crop (h, w) from a row and a column on."""

        def crop(image: jax.Array) -> jax.Array:
            start = (*first, *[jnp.int32(0)] * (image.ndim - 2))
            return jax.lax.dynamic_slice(image, start, (*shape, *image.shape[2:]))

        images = crop(self.observed), crop(self.known), crop(self.log_unknown)
        return replace(self, observed=images[0], known=images[1], log_unknown=images[2])

    def log_factor(self, model: jax.Array, shows: jax.Array, gain_sd: jax.Array) -> jax.Array:
        """Log of the factor (H, W) over u that an object's layer brings, 0 beside it.

        Args:
            model: (H, W, 3) colours of the surface there.
            shows: (H, W) probability that a pixel shows the surface, by its depth; 0 beside it.
            gain_sd: (3,) of its light before the image is seen.
        """
        shows = jnp.where(self.known, shows, 0.0)
        residual = jnp.where(self.known[..., None], self.observed - model, 0.0)
        anything = _normal(self.observed, self.mean, jnp.asarray(ANY_SD))
        alone = _normal(residual, jnp.zeros(3), jnp.hypot(gain_sd, jnp.asarray(SURFACE_SD)))
        alone, other = shows * (1 - OUTLIERS) * alone, (1 - shows * (1 - OUTLIERS)) * anything
        mine = alone / jnp.maximum(alone + other, LEAST_DENSITY)
        continued, left = _continued(residual, mine, self.weights, self.scales)
        surface = continued + left * _normal(residual, *_gain(residual, mine, gain_sd))
        a = OUTLIERS * anything + (1 - OUTLIERS) * surface
        u = jnp.exp(self.log_unknown)
        share = shows * _right(a / (a + u), shows)
        return _unless_all_wrong(jnp.where(shows > 0, jnp.log(1 + share * (a / u - 1)), 0.0))


def window_colours(
    rgb: NDArray[np.uint8], rgb_known: NDArray[np.bool_] | None, window: PixelWindow, gamma: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Colours (h, w, 3) of a window's pixels, each the mean of those that it stands for; which are known.

    Channels without light or with too much of it tell nothing of how much there was.

    Args:
        rgb: (H, W, 3) of the image.
        rgb_known: (H, W) as `Frame.rgb_known`.
        window: of the image.
        gamma: exponent by which stored values become light.
    """
    light = (rgb / 255.0) ** gamma
    clipped = ((rgb == 0) | (rgb == 255)).any(axis=-1)
    known = ~clipped if rgb_known is None else ~clipped & rgb_known
    light = uniform_filter(light, window.stride, mode="nearest", axes=(0, 1))
    return components_of_light(window.of(light)), window.of(known)


def _learned(
    observed: NDArray[np.floating], known: NDArray[np.bool_], mean: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights and scales under which an image is most probable, by expectation maximisation."""
    colours, there = (shifts(jnp.asarray(image)) for image in (observed, known))
    use = np.logical_and.reduce([known, *(np.asarray(there(*by)) for by in BEFORE)])
    differences = np.repeat([(observed - np.asarray(colours(*by)))[use] for by in BEFORE], 2, axis=0)
    fresh = _log_normal(observed[use] - mean, np.array(ANY_SD))
    typical = np.maximum(differences.std(axis=1), LEAST_SCALE) if use.any() else np.ones((2 * len(BEFORE), 3))
    scales = np.maximum(np.tile(FIRST_SCALES, len(BEFORE))[:, None] * typical, LEAST_SCALE)
    weights = np.full(len(scales) + 1, 1 / (len(scales) + 1))
    for _ in range(ITERATIONS if use.any() else 0):
        parts = [_log_normal(one, scale) for one, scale in zip(differences, scales, strict=True)]
        joint = np.log(weights)[:, None] + np.stack([*parts, fresh])
        shares = np.exp(joint - np.logaddexp.reduce(joint, axis=0))
        weights = np.maximum(shares.mean(axis=1), LEAST_WEIGHT)
        weights /= weights.sum()
        squares = np.einsum("kp,kpc->kc", shares[:-1], differences**2)
        scales = np.sqrt(squares / shares[:-1].sum(axis=1)[:, None].clip(1e-9)).clip(LEAST_SCALE)
    return weights, scales


def _log_normal(error: NDArray[np.floating], sigma: NDArray[np.floating]) -> NDArray[np.float64]:
    return (-0.5 * (error / sigma) ** 2 - np.log(sigma * np.sqrt(2 * np.pi))).sum(axis=-1)


def log_unknown(
    observed: jax.Array, known: jax.Array, weights: jax.Array, scales: jax.Array, mean: jax.Array
) -> jax.Array:
    """Log u (H, W) of colours (H, W, 3); the arguments are as in `ColourDensity`."""
    continued, left = _continued(observed, known.astype(observed.dtype), weights, scales)
    return jnp.log(
        jnp.maximum(continued + left * _normal(observed, mean, jnp.asarray(ANY_SD)), LEAST_DENSITY)
    )


_log_unknown = jax.jit(log_unknown, compiler_options=FAST_COMPILE)


def _continued(
    values: jax.Array, there: jax.Array, weights: jax.Array, scales: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Density (H, W) of values (H, W, 3) by those before, and the weight (H, W) that is left.

    Those before count by what they are worth, `there` (H, W).
    """
    continued, left = jnp.zeros(there.shape), jnp.ones(there.shape)
    every = _before(jnp.concatenate([values, there[..., None]], axis=-1))
    for before, narrow in zip(every, range(0, len(scales), 2), strict=True):
        for part in (narrow, narrow + 1):
            share = weights[part] * before[..., 3]
            continued += share * _normal(values, before[..., :3], scales[part])
            left -= share
    return continued, left


def _right(agrees: jax.Array, shows: jax.Array) -> jax.Array:
    """Probability (H, W) that an object's colours are right, by whether those before that show it agree."""
    every = _before(jnp.stack([shows, shows * agrees], axis=-1))
    counts, sums = (functools.reduce(jnp.add, [before[..., part] for before in every]) for part in (0, 1))
    before, told = sums / jnp.maximum(counts, 1e-3), jnp.minimum(counts, 1.0)
    return told * (CHANGES + (1 - 2 * CHANGES) * before) + (1 - told) * (1 - WRONG)


def _unless_all_wrong(log_factors: jax.Array) -> jax.Array:
    """The factors (H, W) of a mixture: with `WRONG` the whole layer has other colours, and a factor of 1."""
    before = jnp.concatenate([jnp.zeros(1), jnp.cumsum(log_factors.ravel())])
    mixed = jnp.logaddexp(jnp.log1p(-WRONG) + before, jnp.log(WRONG))
    return jnp.diff(mixed).reshape(log_factors.shape)


def _gain(residual: jax.Array, shows: jax.Array, gain_sd: jax.Array) -> tuple[jax.Array, jax.Array]:
    """What is foretold of residuals (H, W, 3) by all those before: mean and standard deviation (H, W, 3)."""
    noise, prior = (one[None, None] for one in (jnp.asarray(SURFACE_SD) ** 2, gain_sd**-2.0))
    weights = shows[..., None] / noise
    told, sums = jnp.split(_sums_before(jnp.concatenate([weights, weights * residual], axis=-1)), 2, axis=-1)
    precision = prior + told
    return sums / precision, jnp.sqrt(noise + 1 / precision)


def _sums_before(values: jax.Array) -> jax.Array:
    """Of values (H, W, C) over all pixels before each, row by row."""
    height, width, _ = values.shape
    along = jnp.einsum("ij,hjc->hic", jnp.tril(jnp.ones((width, width), values.dtype), -1), values)
    rows = jnp.tril(jnp.ones((height, height), values.dtype), -1) @ jnp.sum(values, axis=1)
    return along + rows[:, None]


def _before(image: jax.Array) -> list[jax.Array]:
    """For every pixel (H, W, C) those of `BEFORE`, 0 beyond the border.

    By products with matrices: what is shifted is computed once then, and not for every neighbour.
    """
    height, width, _ = image.shape
    rows = {down: jnp.eye(height, k=-down, dtype=image.dtype) for down, _ in BEFORE}
    columns = {across: jnp.eye(width, k=-across, dtype=image.dtype) for _, across in BEFORE}
    above = {down: jnp.einsum("ij,jwc->iwc", rows[down], image) if down else image for down in rows}
    return [
        jnp.einsum("ij,hjc->hic", columns[across], above[down]) if across else above[down]
        for down, across in BEFORE
    ]


def _normal(value: jax.Array, mean: jax.Array, sigma: jax.Array) -> jax.Array:
    """Density (H, W) of three components (H, W, 3); mean and sigma alike, or (3,)."""
    squares = [((value[..., one] - mean[..., one]) / sigma[..., one]) ** 2 for one in range(3)]
    scale = sigma[..., 0] * sigma[..., 1] * sigma[..., 2] * (2 * np.pi) ** 1.5
    return jnp.exp(-0.5 * (squares[0] + squares[1] + squares[2])) / scale
