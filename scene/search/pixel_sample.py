"""The pixels on which the search compares scenes, and what every pose of the pools shows there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from scene.execution import FAST_COMPILE
from scene.likelihood.object_density import object_density
from scene.likelihood.pixel_density import PixelDensity
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import support_depth
from scene.search.assignment import PoseLayers
from scene.search.support_table import SupportTable

FOREGROUND_PIXELS = 2048


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ComparedPixels:
    """At most FOREGROUND_PIXELS pixels of the foreground, weighted; poses meet the others one by one.

    Attributes:
        density: of all the pixels.
        log_odds: of an object in one pose against its absence, before the image is seen.
        rest_m: (H, W) of the supports.
        uncontested: (pixels,) bool, where no object is seen: a pose that covers them has to pay.
        places: (X,) the compared ones among the pixels.
        weight: (X,) how many pixels each of them stands for.
    """

    density: PixelDensity
    log_odds: jax.Array
    rest_m: jax.Array
    uncontested: jax.Array
    places: jax.Array
    weight: jax.Array

    @classmethod
    def of(
        cls,
        data: SceneData,
        noise: DepthNoise,
        surface_sigma_m: float,
        log_odds: float,
        rng: np.random.Generator,
    ) -> ComparedPixels:
        """Pixels of a frame, drawn at random where there are too many.

        Args:
            data: the frame.
            noise: of the sensor.
            surface_sigma_m: error of surfaces, of shapes and of poses in the pool together.
            log_odds: of an object in one pose against its absence, before the image is seen.
            rng: random numbers.
        """
        near, inside = data.window_foreground.ravel(), data.window.inside.ravel()
        places = rng.permutation(np.flatnonzero(near & inside))
        share = min(FOREGROUND_PIXELS / max(len(places), 1), 1.0)
        weight = np.zeros(FOREGROUND_PIXELS, np.float32)
        weight[: len(places)] = 1 / share
        window = data.window
        density = PixelDensity.of(window.depth_m, noise, surface_sigma_m, window.stride)
        numbers = (
            np.float32(log_odds),
            support_depth(data.supports, window, data.intrinsics),
            inside & ~near,
            np.resize(places, FOREGROUND_PIXELS).astype(np.int32),
            weight,
        )
        return cls(density, *map(jax.device_put, numbers))

    def no_layers(self, objects: int, poses: int) -> PoseLayers:
        """Layers of `poses` poses an object of which none shows anything, and of the absent object, last."""
        shape = objects, poses + 1
        log_alone = np.full(shape, self.log_odds, np.float32)
        log_alone[:, -1] = 0.0
        rest_m, rest_log_density = _rest(self)
        return PoseLayers(
            depth_m=jax.device_put(np.full((*shape, FOREGROUND_PIXELS), np.inf, np.float32)),
            log_density=jax.device_put(np.zeros((*shape, FOREGROUND_PIXELS), np.float32)),
            log_alone=jax.device_put(log_alone),
            rests=SupportTable.sure(*shape),
            rest_m=rest_m,
            rest_log_density=rest_log_density,
        )

    def with_layers(
        self,
        layers: PoseLayers,
        depth_m: NDArray[np.float32],
        log_prior: NDArray[np.floating],
        first: int,
        log_colour: jax.Array | None = None,
    ) -> PoseLayers:
        """Layers with poses `first`, `first` + 1, ... of every object replaced by those of the given depth.

        Args:
            layers: of N objects.
            depth_m: (N * n, H, W) of n poses of each object, alone.
            log_prior: (N, n) of these poses, beside the odds of being there.
            first: place of the first of them.
            log_colour: (N * n, H, W) what colours add where each is seen; None where they are not compared.
        """
        by_object = depth_m.reshape(*log_prior.shape, -1)
        return _with_layers(
            self, layers, by_object, log_prior.astype(np.float32), np.int32(first), log_colour
        )


@jax.jit
def _rest(pixels: ComparedPixels) -> tuple[jax.Array, jax.Array]:
    """Depth and log density (X,) of the background."""
    log_rest = pixels.density.of_rest(pixels.rest_m).ravel()
    return pixels.rest_m.ravel()[pixels.places], log_rest[pixels.places] * pixels.weight


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _with_layers(
    pixels: ComparedPixels,
    layers: PoseLayers,
    depth_m: jax.Array,
    log_prior: jax.Array,
    first: jax.Array,
    log_colour: jax.Array | None,
) -> PoseLayers:
    """The layers with depth (N, n, pixels) and priors (N, n) put in from `first` on."""
    rest_m = pixels.rest_m.ravel()
    log_rest = pixels.density.of_rest(pixels.rest_m).ravel()

    def shown(part: tuple[jax.Array, jax.Array | None]) -> tuple[jax.Array, jax.Array, jax.Array]:
        layer_m, colour = part
        parts = object_density(pixels.density, layer_m.reshape(pixels.rest_m.shape), pixels.rest_m)
        density, layer_m = (part.ravel() for part in parts)
        if colour is not None:
            density += colour
        seen = pixels.uncontested & (layer_m < rest_m)
        alone = pixels.log_odds + jnp.sum(jnp.where(seen, density - log_rest, 0.0))
        return layer_m[pixels.places], density[pixels.places] * pixels.weight, alone

    count, poses, size = depth_m.shape
    colours = None if log_colour is None else log_colour.reshape(-1, size)
    by_pose = jax.lax.map(shown, (depth_m.reshape(-1, size), colours))
    shown_m, density, log_alone = (leaf.reshape(count, poses, *leaf.shape[1:]) for leaf in by_pose)
    put = jax.lax.dynamic_update_slice_in_dim
    return PoseLayers(
        depth_m=put(layers.depth_m, shown_m, first, 1),
        log_density=put(layers.log_density, density, first, 1),
        log_alone=put(layers.log_alone, log_alone + log_prior, first, 1),
        rests=layers.rests,
        rest_m=layers.rest_m,
        rest_log_density=layers.rest_log_density,
    )
