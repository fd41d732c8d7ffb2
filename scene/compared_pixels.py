"""The pixels on which the search compares scenes, and what every pose of the pools shows there."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.pose_choice import PoseLayers
from scene.scene_data import SceneData
from shapes import depth_noise

FOREGROUND_PIXELS = 1024
LOWEST_LOG_DENSITY = -20.0


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ComparedPixels:
    """At most FOREGROUND_PIXELS pixels of the foreground, weighted; poses meet the others one by one.

    Attributes:
        noise: of the sensor.
        surface_sigma_m: error of surfaces, of shapes and of poses in the pool together.
        observed_m: (pixels,) of the window.
        rest_m: (pixels,) of the background.
        uncontested: (pixels,) bool, where no object is seen: a pose that covers them has to pay.
        places: (X,) the compared ones among the pixels.
        weight: (X,) how many pixels each of them stands for.
    """

    noise: DepthNoise
    surface_sigma_m: jax.Array
    observed_m: jax.Array
    rest_m: jax.Array
    uncontested: jax.Array
    places: jax.Array
    weight: jax.Array

    @classmethod
    def of(
        cls, data: SceneData, noise: DepthNoise, surface_sigma_m: float, rng: np.random.Generator
    ) -> ComparedPixels:
        """Pixels of a frame, drawn at random where there are too many."""
        near, inside = data.window_foreground.ravel(), data.window.inside.ravel()
        places = rng.permutation(np.flatnonzero(near & inside))
        share = min(FOREGROUND_PIXELS / max(len(places), 1), 1.0)
        weight = np.zeros(FOREGROUND_PIXELS, np.float32)
        weight[: len(places)] = 1 / share
        return cls(
            noise,
            jnp.asarray(surface_sigma_m, jnp.float32),
            jnp.asarray(data.window.depth_m.ravel()),
            jnp.asarray(data.rest_m.ravel()),
            jnp.asarray(inside & ~near),
            jnp.asarray(np.resize(places, FOREGROUND_PIXELS)),
            jnp.asarray(weight),
        )

    def no_layers(self, objects: int, poses: int) -> PoseLayers:
        """Layers of `poses` poses an object of which none shows anything, and of the absent object, last."""
        shape = objects, poses + 1
        return PoseLayers(
            depth_m=jnp.asarray(np.full((*shape, FOREGROUND_PIXELS), np.inf, np.float32)),
            log_density=jnp.asarray(np.zeros((*shape, FOREGROUND_PIXELS), np.float32)),
            log_alone=jnp.asarray(np.zeros(shape, np.float32)),
            rest_m=self.rest_m[self.places],
            rest_log_density=_rest_log_density(self),
        )

    def with_layers(
        self, layers: PoseLayers, depth_m: NDArray[np.float32], objects: int, first: int
    ) -> PoseLayers:
        """Layers with poses `first`, `first` + 1, ... of every object replaced by those of the given depth.

        Args:
            layers: of `objects` objects.
            depth_m: (objects * n, pixels) of n poses of each object, alone.
            objects: how many.
            first: place of the first of them.
        """
        by_object = jnp.asarray(depth_m.reshape(objects, -1, depth_m[0].size))
        return _with_layers(self, layers, by_object, jnp.asarray(first, jnp.int32))


@jax.jit
def _rest_log_density(pixels: ComparedPixels) -> jax.Array:
    return _log_density(pixels, pixels.observed_m, pixels.rest_m)[pixels.places] * pixels.weight


@jax.jit
def _with_layers(
    pixels: ComparedPixels, layers: PoseLayers, depth_m: jax.Array, first: jax.Array
) -> PoseLayers:
    """The layers with depth (N, n, pixels) put in from `first` on."""
    rest = _log_density(pixels, pixels.observed_m, pixels.rest_m)

    def alone(layer_m: jax.Array) -> jax.Array:
        gain = _log_density(pixels, pixels.observed_m, layer_m) - rest
        return jnp.sum(jnp.where(pixels.uncontested & (layer_m < pixels.rest_m), gain, 0.0))

    count, poses, size = depth_m.shape
    log_alone = jax.lax.map(alone, depth_m.reshape(-1, size)).reshape(count, poses)
    shown_m = depth_m[:, :, pixels.places]
    density = _log_density(pixels, pixels.observed_m[pixels.places][None, None], shown_m)
    put = jax.lax.dynamic_update_slice_in_dim
    return PoseLayers(
        depth_m=put(layers.depth_m, shown_m, first, 1),
        log_density=put(layers.log_density, density * pixels.weight[None, None], first, 1),
        log_alone=put(layers.log_alone, log_alone, first, 1),
        rest_m=layers.rest_m,
        rest_log_density=layers.rest_log_density,
    )


def _log_density(pixels: ComparedPixels, observed_m: jax.Array, depth_m: jax.Array) -> jax.Array:
    observed_m = jnp.broadcast_to(observed_m, depth_m.shape)
    density = depth_noise.log_density(pixels.noise, observed_m, depth_m, pixels.surface_sigma_m)
    return jnp.maximum(density, LOWEST_LOG_DENSITY)
