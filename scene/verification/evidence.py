"""How much better a scene with an object explains the image than the scene without it, as a density.

`scene.likelihood.pixel_density` of the pixels on which scenes are compared. Nothing is counted, and no
constant is fitted to right and wrong answers. What lies in an object's place and looks like it is an unknown
surface, which the pixels before foretell as well as the object does; what tells the two apart are edges,
curvature, and where the object ends.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.execution import FAST_COMPILE
from scene.likelihood.pixel_density import PixelDensity
from scene.observation.segmentation import support_depth
from scene.search.hypotheses import PosePools


def log_evidence(pools: PosePools, scene: NDArray[np.integer], noise: DepthNoise) -> NDArray[np.float64]:
    """Log density (N,) of the image with each object of a scene less that without; 0 for absent ones.

    Args:
        pools: of poses.
        scene: (N,) one of each object.
        noise: of the sensor.
    """
    data, window = pools.data, pools.data.window
    density = PixelDensity.of(window.depth_m, noise, pools.config.search_error_m, window.stride)
    support_m = support_depth(data.supports, window, data.intrinsics)
    shown_m = pools.shown(scene)
    gains = np.zeros(len(scene))
    for one in np.flatnonzero(scene < pools.absent).tolist():
        rest_m = np.minimum(np.delete(shown_m, one, axis=0).min(axis=0, initial=np.inf), support_m)
        gains[one] = log_gain(density, shown_m[one], rest_m, window.inside)
    return gains


@partial(jax.jit, compiler_options=FAST_COMPILE)
def log_gain(density: PixelDensity, layer_m: jax.Array, rest_m: jax.Array, inside: jax.Array) -> jax.Array:
    """Log density of an image with an object less that without it.

    Args:
        density: of the image.
        layer_m: (H, W) depth of the object alone, +inf beside it.
        rest_m: (H, W) of what else the scene holds.
        inside: (H, W) bool, False beyond the image.
    """
    shown, depth_m = density.of_object(layer_m, rest_m)
    touched = inside & jnp.isfinite(depth_m)
    return jnp.sum(jnp.where(touched, shown - density.of_rest(rest_m), 0.0))
