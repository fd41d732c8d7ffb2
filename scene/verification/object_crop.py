"""One object of a scene, looked at as closely as the image allows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.execution import map_parallel
from scene.observation.frame_data import SceneData
from scene.observation.pixel_window import window_over
from scene.observation.segmentation import background
from scene.search.hypotheses import PosePools
from shapes.depth_noise import standard_deviation

ROUND_M = 0.012
"""What is seen so far beside an object is looked at too."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CloseView:
    """What is seen and what a scene foretells round one of its objects.

    Attributes:
        observed_m: (H, W) measured depth, `NO_RETURN` also beyond the image.
        layer_m: (H, W) depth of the object alone, +inf beside it.
        others_m: (H, W) of the scene's other objects.
        rest_m: (H, W) of what is behind them all.
        sigma_m: (H, W) standard deviation of the sensor and the surfaces together where the object is.
        focal_px: by which a length over its depth is so many pixels.
        weight: how many of the pixels on which scenes are compared one of these is.
    """

    observed_m: NDArray[np.floating]
    layer_m: NDArray[np.floating]
    others_m: NDArray[np.floating]
    rest_m: NDArray[np.floating]
    sigma_m: NDArray[np.floating]
    focal_px: float
    weight: float

    def pixels(self, length_m: float) -> int:
        """A length at the object's depth, at least one pixel."""
        return max(1, round(length_m * self.focal_px / float(np.median(self.layer_m[self.covers]))))

    @property
    def covers(self) -> NDArray[np.bool_]:
        """Where the object is."""
        return np.isfinite(self.layer_m)


def close_views(pools: PosePools, scene: NDArray[np.integer], noise: DepthNoise) -> dict[int, CloseView]:
    """A view of every object that a scene shows in the image, by number.

    Args:
        pools: of poses.
        scene: (N,) one of each object.
        noise: of the sensor and the surfaces together.
    """
    shown_m = np.where(pools.data.window.inside, pools.shown(scene), np.inf)
    seen = np.flatnonzero(np.isfinite(shown_m).any(axis=(1, 2))).tolist()
    views = map_parallel(lambda one: _close_view(pools, scene, one, shown_m[one], noise), seen)
    return {one: view for one, view in zip(seen, views, strict=True) if view.covers.any()}


def _close_view(
    pools: PosePools, scene: NDArray[np.integer], one: int, shown_m: NDArray[np.floating], noise: DepthNoise
) -> CloseView:
    data = pools.data
    window = window_over(_region(data, shown_m), data.depth_m, data.intrinsics)
    found = np.flatnonzero(scene < pools.absent)
    layers_m = pools.renderer.layers(found, pools.placed(scene)[found], window)
    layer_m = layers_m[found == one][0]
    return CloseView(
        observed_m=window.depth_m,
        layer_m=layer_m,
        others_m=layers_m[found != one].min(axis=0, initial=np.inf),
        rest_m=background(data.supports, data.near, window, data.intrinsics),
        sigma_m=np.asarray(standard_deviation(noise, jnp.where(np.isfinite(layer_m), layer_m, 1.0))),
        focal_px=float(window.camera.fx),
        weight=(window.stride / data.window.stride) ** 2,
    )


def _region(data: SceneData, shown_m: NDArray[np.floating]) -> NDArray[np.bool_]:
    """The pixels of the image round those of the window in which an object (H, W) is."""
    margin = data.window.stride + math.ceil(ROUND_M * data.intrinsics.fx / float(shown_m.min()))
    covers, region = np.isfinite(shown_m), np.zeros_like(data.near)
    spans = [
        slice(max(at[hit].min() - margin, 0), at[hit].max() + margin + 1)
        for at, hit in ((data.window.rows, covers.any(axis=1)), (data.window.columns, covers.any(axis=0)))
    ]
    region[tuple(spans)] = True
    return region
