"""What unknown things would look like: the rival of every asked-for object where something stands.

An unknown surface explains its own depth: it goes on as its neighbours in the image do, or another one begins
there. So an object earns little for lying on a smooth surface, and much for telling where surfaces end and
bend; and where it ends while what is seen goes on, another surface would have to begin right there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from recordings.types import NO_RETURN, DepthNoise
from scene.scene_data import SceneData

BEGINS = 0.1
"""Share of pixels at which another surface begins."""
REACH_M = 0.3
"""Depths among which it does."""
ROUGHNESS_M = 0.004
"""How well neighbours foretell an unknown surface: about as well as a known shape foretells a real one."""


SQUARE = np.ones((1, 3, 3), bool)


def log_density_of_clutter(data: SceneData, noise: DepthNoise) -> NDArray[np.float64]:
    """Log density (H, W) of the window's foreground given its neighbours; -inf where no thing can be.

    (1 - BEGINS) Normal(z; z^, sigma) + BEGINS / REACH_M, with z^ the mean of two opposite neighbours, of the
    two pairs the one that fits worse: a surface is smooth if it is so along and across. Not a density of
    the image as a whole, in which every pixel would serve as a neighbour once.

    Args:
        data: one frame.
        noise: of the sensor and of surfaces together.
    """
    observed_m = data.window.depth_m
    sensor_m = noise.sigma_base_m + noise.sigma_growth_per_m * (observed_m - 0.4) ** 2
    sigma_m = np.hypot(np.sqrt(1.5) * sensor_m, ROUGHNESS_M)
    bend_m = np.maximum(_bend(observed_m, 0), _bend(observed_m, 1))
    smooth = np.exp(-0.5 * (bend_m / sigma_m) ** 2) / (np.sqrt(2 * np.pi) * sigma_m)
    density = np.log1p(-noise.none_hit_probability) + np.log((1 - BEGINS) * smooth + BEGINS / REACH_M)
    return np.where(data.window_foreground & (observed_m != NO_RETURN), density, -np.inf)


def log_gain_over_clutter(
    data: SceneData,
    noise: DepthNoise,
    shown: NDArray[np.bool_],
    log_object: NDArray[np.floating],
    log_rest: NDArray[np.floating],
) -> NDArray[np.float64]:
    """Log ratio (N,) of the pixels with each object and with something unknown in its place.

    Just outside the object, one pixel left out for blurred edges, an unknown surface cannot go on from it.

    Args:
        data: one frame.
        noise: of the sensor and of surfaces together.
        shown: (N, H, W) pixels that show each object.
        log_object: (N, H, W) log density of the pixels where it is shown.
        log_rest: (N, H, W) of the pixels where neither it nor anything unknown is.
    """
    clutter = log_density_of_clutter(data, noise)
    begins = np.where(np.isfinite(clutter), np.log(BEGINS / REACH_M), -np.inf)
    without = np.maximum(log_rest, clutter)
    edge = np.asarray(binary_dilation(shown, SQUARE), bool)
    around = np.asarray(binary_dilation(edge, SQUARE), bool) & ~edge
    gain = np.where(shown, log_object - without, 0.0)
    lost = np.where(around, np.minimum(np.maximum(log_rest, begins) - without, 0.0), 0.0)
    return (gain + lost).sum(axis=(1, 2))


def _bend(depth_m: NDArray[np.float32], axis: int) -> NDArray[np.float64]:
    """Distance of each pixel from the mean of its two neighbours along an axis; 0 where one is unknown."""
    padded = np.pad(depth_m.astype(np.float64), 1, constant_values=NO_RETURN)
    before, after = (np.roll(padded, step, axis)[1:-1, 1:-1] for step in (1, -1))
    known = (before != NO_RETURN) & (after != NO_RETURN)
    return np.where(known, np.abs(depth_m - (before + after) / 2), 0.0)
