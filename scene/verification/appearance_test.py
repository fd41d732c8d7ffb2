"""Whether a found object is what was asked for, or another thing that looks like it from here.

Where a thing of nearly the same shape stands in an object's place, a scene with the object is far better than
one without it, for what agrees pays for what does not. But of the right shape nearly all that is seen agrees
with the image, most of it closely; nothing of it is behind the table or what was seen where no object may be;
and where its outline ends the image shows an edge. Of a thing that happens to be like the shape some share
does, whatever it is. These shares are counted, and their probabilities under either compared.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_dilation, binary_erosion, minimum_filter
from scipy.special import betaln

from recordings.types import NO_RETURN
from scene.verification.object_crop import CloseView

SIGMAS, CLOSE_SIGMAS = 2.0, 0.75
"""Standard deviations of the sensor and the surfaces together within which a pixel agrees, and closely."""

GOES_ON_M, BEHIND_M = 0.01, 0.015
"""Surfaces less than the first apart go on from each other; more than the second behind is another."""

RIM_M, BESIDE_M = 0.003, 0.007
"""An object's surface is judged the first inside its outline and the second away from what hides it, and its
outline the second beside it: cameras shift edges."""

THIN = 0.3
"""Least share of the visible pixels that has to be there for the others to be left out."""


def log_ratio_of_lookalike(view: CloseView, pixel_weight: float) -> float:
    """Log probability of what is seen of an object that is there less that of a lookalike in its place.

    Counts are of as many pixels as are independent: beta-binomial with trials and successes times
    the view's and `pixel_weight`.

    Args:
        view: of the object in the scene.
        pixel_weight: effective over actual number of the pixels on which scenes are compared.
    """
    weight = pixel_weight * view.weight
    return sum(_log_ratio(weight * count(view), *shares) for count, shares in QUESTIONS.items())


def agreeing_pixels(view: CloseView) -> NDArray[np.intp]:
    """How many pixels show an object at the depth where it should be, and another; (2,).

    Where something is seen well in front of it, it is hidden, by what nobody asked for.
    """
    seen = _seen(view)
    return _counts(seen & _within(view, SIGMAS), seen)


def closely_agreeing_pixels(view: CloseView) -> NDArray[np.intp]:
    """How many of those that agree do so closely, and how many do not; (2,)."""
    agree = _seen(view) & _within(view, SIGMAS)
    return _counts(agree & _within(view, CLOSE_SIGMAS), agree)


def uncovered_pixels(view: CloseView) -> NDArray[np.intp]:
    """How many pixels can show an object, and how many show what is known to be behind all objects; (2,)."""
    visible = _visible(view) & _measured(view)
    return _counts(visible & (view.layer_m < view.rest_m + BEHIND_M), visible)


def ending_pixels(view: CloseView) -> NDArray[np.intp]:
    """How many pixels beside an object end where it does, and how many go on instead; (2,).

    Those beside which the scene goes on as well tell nothing. Where it shows neither an edge nor what the
    scene foretells, the surface is that of something larger.
    """
    reach = view.pixels(BESIDE_M)
    near = np.isfinite(minimum_filter(view.layer_m, 2 * reach - 1))
    whole = np.asarray(binary_closing(np.pad(near, 2), _SQUARE), bool)[2:-2, 2:-2]
    surface_m = minimum_filter(view.layer_m, 2 * reach + 1)
    beside = np.isfinite(surface_m) & ~whole & _measured(view)
    surface_m = np.where(beside, surface_m, 0.0)
    scene_m = np.minimum(view.others_m, view.rest_m)
    tells = beside & (scene_m > surface_m + BEHIND_M)
    goes_on = np.abs(view.observed_m - surface_m) < GOES_ON_M
    goes_on &= np.abs(view.observed_m - scene_m) > GOES_ON_M
    return _counts(tells & ~goes_on, tells)


QUESTIONS: dict[Callable[[CloseView], NDArray[np.intp]], tuple[tuple[float, float], ...]] = {
    agreeing_pixels: ((87.0, 2.45), (5.95, 1.3)),
    closely_agreeing_pixels: ((24.6, 9.0), (21.7, 15.4)),
    uncovered_pixels: ((2.5, 0.02), (2.0, 0.14)),
    ending_pixels: ((750.0, 2.6), (10.4, 2.6)),
}
"""What is counted, and the parameters of the beta distribution of its share of an object's pixels, and of a
lookalike's.

Fitted to 91 right fits, those in real frames counted forty times, and 216 wrong ones: 14 synthetic tables
(docs/model.md, development films), YCB-Video's 0002 (frames 0, 10 and 19, asked for all shapes and for
absent ones) and every other of its synthetic frames, 7-Scenes' kitchen from frame 240 on, Redwood's room.
"""

_SQUARE = np.ones((3, 3))


def _visible(view: CloseView) -> NDArray[np.bool_]:
    """Pixels of an object that no other hides, away from the border; where little is left all of them."""
    visible = view.covers & (view.layer_m <= view.others_m)
    hidden = np.asarray(
        binary_dilation(view.covers & ~visible, _SQUARE, iterations=view.pixels(BESIDE_M)), bool
    )
    inside = binary_erosion(np.pad(view.covers, 1), _SQUARE, iterations=view.pixels(RIM_M))[1:-1, 1:-1]
    inside = inside & ~hidden
    return np.asarray(inside if inside.sum() > THIN * visible.sum() else visible, bool)


def _seen(view: CloseView) -> NDArray[np.bool_]:
    """Pixels that show an object, or what is behind it, if nothing unknown hides it."""
    hidden = view.observed_m < view.layer_m - GOES_ON_M
    return _visible(view) & (view.layer_m <= view.rest_m) & _measured(view) & ~hidden


def _within(view: CloseView, sigmas: float) -> NDArray[np.bool_]:
    gap_m = np.where(view.covers, view.observed_m - view.layer_m, np.inf)
    return np.abs(gap_m) < sigmas * view.sigma_m


def _measured(view: CloseView) -> NDArray[np.bool_]:
    return view.observed_m != NO_RETURN


def _counts(successes: NDArray[np.bool_], trials: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Successes and failures (2,) among the trials."""
    return np.array([successes.sum(), trials.sum() - successes.sum()])


def _log_ratio(
    counts: NDArray[np.floating], first: tuple[float, float], second: tuple[float, float]
) -> float:
    """Of the beta-binomial probabilities of successes and failures (2,) under either distribution."""
    one, other = (betaln(*(counts + np.array(share))) - betaln(*share) for share in (first, second))
    return float(one - other)
