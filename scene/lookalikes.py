"""Whether a found object is what was asked for, or another thing that looks like it from here.

Where a thing of nearly the same shape stands in an object's place, a scene with the object is far better than
one without it, for what agrees pays for what does not. But of the right shape nearly all that is seen agrees
with the image, and where its outline ends the image shows an edge; of a thing that happens to be like the
shape some share does, whatever it is. Both shares are counted, and their probabilities under either compared.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, minimum_filter
from scipy.special import betaln, logit

from recordings.types import NO_RETURN, DepthNoise
from scene.scene_data import SceneData
from shapes import depth_noise

SIGMAS = 2.0
"""Standard deviations of the sensor and the surfaces together within which a pixel agrees."""
GOES_ON_M, BEHIND_M = 0.01, 0.015
"""Surfaces less than the first apart go on from each other; more than the second behind is another."""
AGREEING = (40.0, 1.4), (9.0, 3.0)
"""Parameters of the beta distribution of the share of an object's pixels that agree, and of a lookalike's.

These and the next were fitted to 109 right and 96 wrong fits on 14 synthetic tables (seeds 91000 to 91007,
92000 to 92005), 61 right ones in 11 of YCB-Video's synthetic frames, and 10, counted six times, in two real
ones.
"""
ENDING = (20.0, 0.6), (5.5, 2.0)
"""The same of the share of the pixels beside them where the image ends too."""


def log_odds_against_lookalikes(
    data: SceneData, noise: DepthNoise, layers_m: NDArray[np.floating], presence: float, pixel_weight: float
) -> NDArray[np.float64]:
    """Log odds (N,) of every object of a scene being there against a lookalike in its place.

    Counts are of as many pixels as are independent: beta-binomial with trials and successes times
    `pixel_weight`. Every object that is not there is taken to have a lookalike.

    Args:
        data: the frame.
        noise: of the sensor and the surfaces together.
        layers_m: (N, H, W) depth of each object alone in the window, +inf where it is not seen.
        presence: prior probability.
        pixel_weight: effective over actual number of pixels.
    """
    scene_m = np.minimum(layers_m.min(axis=0, initial=np.inf), data.rest_m)
    odds = [logit(presence)] * len(layers_m)
    for one, layer_m in enumerate(layers_m):
        agreeing = pixel_weight * agreeing_pixels(data, noise, scene_m, layer_m)
        ending = pixel_weight * ending_pixels(data, scene_m, layer_m)
        odds[one] += _log_ratio(agreeing, AGREEING) + _log_ratio(ending, ENDING)
    return np.array(odds, np.float64)


def agreeing_pixels(
    data: SceneData, noise: DepthNoise, scene_m: NDArray[np.floating], layer_m: NDArray[np.floating]
) -> NDArray[np.intp]:
    """How many pixels show an object at the depth (H, W) where it should be, and another; (2,).

    Where something is seen well in front of it, it is hidden, by what nobody asked for.
    """
    covers = np.isfinite(layer_m)
    layer_m = np.where(covers, layer_m, 1.0)
    gap_m = data.window.depth_m - layer_m
    seen = covers & (layer_m <= scene_m) & _measured(data) & (gap_m > -GOES_ON_M)
    sigma_m = np.asarray(depth_noise.standard_deviation(noise, jnp.asarray(layer_m)))
    agree = np.abs(gap_m) < SIGMAS * sigma_m
    return np.array([(seen & agree).sum(), (seen & ~agree).sum()])


def ending_pixels(
    data: SceneData, scene_m: NDArray[np.floating], layer_m: NDArray[np.floating]
) -> NDArray[np.intp]:
    """How many pixels beside an object (H, W) end where it does, and how many go on instead; (2,).

    Those beside which the scene (H, W) goes on as well tell nothing. Where it shows neither an edge nor what
    the scene foretells, the surface is that of something larger.
    """
    covers = np.isfinite(layer_m)
    whole = np.asarray(binary_closing(np.pad(covers, 2), np.ones((3, 3))), bool)[2:-2, 2:-2]
    surface_m = minimum_filter(layer_m, 3)
    beside = np.isfinite(surface_m) & ~whole & (scene_m > surface_m + BEHIND_M) & _measured(data)
    surface_m = np.where(beside, surface_m, 0.0)
    goes_on = np.abs(data.window.depth_m - surface_m) < GOES_ON_M
    goes_on &= np.abs(data.window.depth_m - scene_m) > GOES_ON_M
    return np.array([(beside & ~goes_on).sum(), (beside & goes_on).sum()])


def _measured(data: SceneData) -> NDArray[np.bool_]:
    return data.window.inside & (data.window.depth_m != NO_RETURN)


def _log_ratio(
    counts: NDArray[np.floating], shares: tuple[tuple[float, float], tuple[float, float]]
) -> float:
    """Of the beta-binomial probabilities of successes and failures (2,) under either distribution."""
    first, second = (betaln(*(counts + share)) - betaln(*share) for share in np.array(shares))
    return float(first - second)
