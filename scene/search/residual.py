"""What a scene leaves unexplained, where the search goes on."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN
from scene.search.hypotheses import PosePools
from scene.search.search_round import log_gains
from shapes.depth_noise import standard_deviation

AGREE_SIGMAS = 3.0
"""Standard deviations of a measurement within which a pixel shows a surface: all but 3 in 1,000 do."""

FITTING = 0.85
"""Objects with a smaller share of pixels that show them are sought again, and explain nothing to the others:
they may be wrong."""


def unexplained_by_others(
    pools: PosePools, scene: NDArray[np.integer], *, by_all: bool = False
) -> dict[int, NDArray[np.bool_]]:
    """For every object that a scene lacks, or that fits badly, the foreground that others leave to it.

    The one of them that the scene would miss least leaves it what it shows, for another may be in its place;
    but not where all explain what they show (`by_all`).
    """
    shown_m = pools.shown(scene)
    fits = _fit(pools, shown_m) >= FITTING
    shown_m[~fits] = np.inf
    if not by_all and (scene < pools.absent).any():
        without = np.asarray(log_gains(pools.layers, scene))[:, pools.absent]
        shown_m[np.where(scene < pools.absent, without, -np.inf).argmax()] = np.inf
    sought = np.flatnonzero(~fits).tolist()
    return {one: _unexplained(pools, np.delete(shown_m, one, axis=0)) for one in sought}


def _fit(pools: PosePools, shown_m: NDArray[np.float32]) -> NDArray[np.float64]:
    """The share (N,) of what each layer (N, H, W) shows in the scene that agrees with the measurements."""
    data = pools.data
    observed_m = data.window.depth_m
    front_m = np.minimum(shown_m.min(axis=0), data.rest_m)
    seen = np.isfinite(shown_m) & (shown_m <= front_m) & (observed_m != NO_RETURN)
    agree = seen & (np.abs(shown_m - observed_m) < _tolerance_m(pools, observed_m))
    return agree.sum(axis=(1, 2)) / np.maximum(seen.sum(axis=(1, 2)), 1)


def _tolerance_m(pools: PosePools, depth_m: NDArray[np.float32]) -> NDArray[np.float64]:
    """By how much measured depths (...) may differ from those of the surface that they show."""
    sigma_m = np.asarray(standard_deviation(pools.noise, depth_m), np.float64)
    return AGREE_SIGMAS * np.hypot(sigma_m, pools.config.search_error_m)


def _unexplained(pools: PosePools, others_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The view's foreground that other objects, layers (N - 1, H, W) of the window, leave unexplained.

    What they show in a neighbouring pixel of the window explains a pixel too.
    """
    data = pools.data
    view, camera = data.view, data.window.camera
    rows, columns = np.nonzero(data.foreground)
    observed_m = np.asarray(view.depth_m)[rows, columns]
    u = (columns - float(view.camera.cx)) / float(view.camera.fx) * float(camera.fx) + float(camera.cx)
    v = (rows - float(view.camera.cy)) / float(view.camera.fy) * float(camera.fy) + float(camera.cy)
    front_m = np.pad(others_m.min(axis=0, initial=np.inf), 1, constant_values=np.inf)
    height, width = data.rest_m.shape
    u, v = np.clip(np.rint(u).astype(int), 0, width - 1), np.clip(np.rint(v).astype(int), 0, height - 1)
    gap_m = np.full(len(rows), np.inf)
    for down, across in itertools.product(range(3), repeat=2):
        gap_m = np.minimum(gap_m, np.abs(front_m[v + down, u + across] - observed_m))
    mask = np.zeros_like(data.foreground)
    mask[rows, columns] = gap_m >= _tolerance_m(pools, observed_m)
    return mask
