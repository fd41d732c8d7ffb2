"""What objects show in images, computed where they are and not elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from scene.execution import map_parallel
from scene.likelihood.object_pixels import ObjectPixels
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.pixel_places import Places
from shapes.rendering.ray_casting import sort_chosen_first

PIXELS_TOGETHER = 2**12
"""Of a list that are computed together, so that they stay in a core's cache: speed."""

WEIGHED_TOGETHER = 64
"""Of a kernel; kernels run side by side, each on a core, and one size serves any number."""

Layers = tuple[jax.Array, jax.Array]


def layer_densities(
    density: PixelDensity, layers_m: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What `object_densities` gives for any number of layers (n, H, W) in one image."""

    def weighed(first: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        count = min(WEIGHED_TOGETHER, len(layers_m) - first)
        filled = np.full((WEIGHED_TOGETHER, *layers_m.shape[1:]), np.float32(np.inf))
        filled[:count] = layers_m[first : first + count]
        log_density, depth_m = jax.device_get(_layer_densities(density, filled))
        return log_density[:count], depth_m[:count]

    parts = map_parallel(weighed, range(0, len(layers_m), WEIGHED_TOGETHER))
    log_density, depth_m = (np.concatenate(leaves) for leaves in zip(*parts, strict=True))
    return log_density, depth_m


def compile_layer_densities(density: PixelDensity) -> None:
    """What `layer_densities` runs."""
    nothing = np.full((WEIGHED_TOGETHER, *density.log_rest.shape), np.float32(np.inf))
    _layer_densities.lower(density, nothing).compile()


@jax.jit
def _layer_densities(density: PixelDensity, layers_m: jax.Array) -> Layers:
    return object_densities(density.stacked(), layers_m, jnp.zeros(len(layers_m), jnp.int32))


def object_densities(density: PixelDensity, layers_m: jax.Array, frames: jax.Array) -> Layers:
    """What `PixelDensity.of_object` gives where depths are finite; elsewhere a log density of 0.

    Args:
        density: of F images, leaves (F, ...).
        layers_m: (n, H, W) depth of objects, each alone, +inf beside it.
        frames: (n,) int32 in which image each is seen.
    """
    pixels = ObjectPixels.of(layers_m, density.image.rest_m[frames])
    objects = density.object_images(pixels, frames)
    size, count = layers_m.shape, layers_m.size
    order, number = sort_chosen_first(jnp.isfinite(pixels.shown_m).ravel())
    together = min(PIXELS_TOGETHER, count)
    order = jnp.pad(order, (0, -count % together))

    def in_parts(of_places: Callable[[Places], jax.Array], nothing: jax.Array) -> jax.Array:
        """Images (n, H, W) with values (P,) of all listed pixels."""

        def with_part(turn: jax.Array, values: jax.Array) -> jax.Array:
            first = turn * together
            numbers = jax.lax.dynamic_slice(order, (first,), (together,))
            listed = first + jnp.arange(together, dtype=jnp.int32) < number
            part = of_places(Places.of_numbers(numbers, size)).astype(values.dtype)
            return values.at[jnp.where(listed, numbers, count)].set(part, mode="drop")

        turns = -(-number // together)
        return jax.lax.fori_loop(0, turns, with_part, jnp.full(count, nothing)).reshape(size)

    badly = in_parts(partial(density.badly_foretold, objects.surfaces, frames), jnp.array(False))
    objects = replace(objects, surfaces=replace(objects.surfaces, badly_foretold=badly))
    log_density = in_parts(partial(density.log_factors, objects, frames), jnp.zeros((), layers_m.dtype))
    return log_density, pixels.shown_m
