"""What a scene leaves unexplained, where the search goes on."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN
from scene.observation.frame_data import SceneData
from scene.search.hypotheses import PosePools
from scene.search.search_round import log_gains

UNEXPLAINED_M = 0.012
"""Gap between a pixel's depth and all other objects' from which on it is unexplained."""

AGREE_M, FITTING = 0.006, 0.85
"""Objects that fit what is seen of them less well are sought again, and explain nothing to the others: they
may be wrong."""


def unexplained_by_others(
    pools: PosePools, scene: NDArray[np.integer], *, by_all: bool = False
) -> dict[int, NDArray[np.bool_]]:
    """For every object that a scene lacks, or that fits badly, the foreground that others leave to it.

    The one of them that the scene would miss least leaves it what it shows, for another may be in its place;
    but not where all explain what they show (`by_all`).
    """
    shown_m = pools.shown(scene)
    fits = _fit(pools.data, shown_m) >= FITTING
    shown_m[~fits] = np.inf
    if not by_all and (scene < pools.absent).any():
        without = np.asarray(log_gains(pools.layers, scene))[:, pools.absent]
        shown_m[np.where(scene < pools.absent, without, -np.inf).argmax()] = np.inf
    sought = np.flatnonzero(~fits).tolist()
    return {one: _unexplained(pools.data, np.delete(shown_m, one, axis=0)) for one in sought}


def _fit(data: SceneData, shown_m: NDArray[np.float32]) -> NDArray[np.float64]:
    """The share (N,) of what each layer (N, H, W) shows in the scene that agrees with the measurements."""
    observed_m = data.window.depth_m
    front_m = np.minimum(shown_m.min(axis=0), data.rest_m)
    seen = np.isfinite(shown_m) & (shown_m <= front_m) & (observed_m != NO_RETURN)
    agree = seen & (np.abs(shown_m - observed_m) < AGREE_M)
    return agree.sum(axis=(1, 2)) / np.maximum(seen.sum(axis=(1, 2)), 1)


def _unexplained(data: SceneData, others_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The view's foreground that other objects, layers (N - 1, H, W) of the window, leave unexplained.

    What they show in a neighbouring pixel of the window explains a pixel too.
    """
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
    mask[rows, columns] = gap_m >= UNEXPLAINED_M
    return mask
