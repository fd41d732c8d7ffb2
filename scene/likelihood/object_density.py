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
from scene.likelihood.crops import Crops, crop_sizes, crops_around, lines_around, most_members
from scene.likelihood.object_pixels import ObjectPixels
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.pixel_places import ImageParts, Places
from shapes.rendering.ray_casting import sort_chosen_first
from shapes.stored_kernels import jit_stored

PIXELS_TOGETHER = 2**12
"""Of a list that are computed together, so that they stay in a core's cache: speed."""

Layers = tuple[jax.Array, jax.Array]

Image = NDArray[np.float32]


def layer_densities(
    density: PixelDensity, layers_m: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What `object_densities` gives for any number of layers (n, H, W) in one image."""
    return _in_crops(density, layers_m, lambda crops, *parts: parts)  # noqa: ARG005


def layer_gains(
    density: PixelDensity, layers_m: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth of layers (n, H, W) where they are before the supports, and what they add to their log density.

    Elsewhere +inf and 0.
    """
    rest_m, log_rest = np.asarray(density.image.rest_m), np.asarray(density.log_rest)

    def over_rest(crops: Crops, log_density: Image, depth_m: Image) -> tuple[Image, Image]:
        before = depth_m < crops.of(rest_m)
        return np.where(before, log_density - crops.of(log_rest), 0), np.where(before, depth_m, np.inf)

    gain, depth_m = _in_crops(density, layers_m, over_rest)
    return depth_m, gain


def _in_crops(
    density: PixelDensity,
    layers_m: NDArray[np.float32],
    finish: Callable[[Crops, Image, Image], tuple[Image, Image]],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Images (n, H, W) of what log densities and depths (m, h, w) of crops become; beside these 0, +inf."""
    values, depth_m = np.zeros_like(layers_m), np.full_like(layers_m, np.inf)

    def weigh(crops: Crops) -> None:
        corners = crops.filled(crops.corners)
        cut = np.full((len(corners), *crops.size), np.float32(np.inf))
        cut[: len(crops.members)] = crops.taken(layers_m)
        parts = jax.device_get(_cropped_densities(density, cut, corners))
        of_values, of_depth_m = finish(crops, *(part[: len(crops.members)] for part in parts))
        crops.put(values, of_values)
        crops.put(depth_m, of_depth_m)

    bounds = lines_around(np.isfinite(layers_m))
    map_parallel(weigh, crops_around(*bounds, layers_m.shape[1:]))
    return values, depth_m


def compile_layer_densities(density: PixelDensity) -> None:
    """What `layer_densities` runs."""
    for size in crop_sizes(density.log_rest.shape):
        nothing = np.full((most_members(size), *size), np.float32(np.inf))
        _cropped_densities.lower(density, nothing, np.zeros((len(nothing), 2), np.int32)).compile()


@jit_stored()
def _cropped_densities(density: PixelDensity, layers_m: jax.Array, corners: jax.Array) -> Layers:
    """Of layers (n, h, w) in parts of one image, with these first rows and columns (n, 2)."""
    parts = ImageParts(jnp.zeros(len(layers_m), jnp.int32), corners)
    return object_densities(density.stacked(), layers_m, parts)


def object_densities(density: PixelDensity, layers_m: jax.Array, parts: ImageParts) -> Layers:
    """Log density (n, h, w) of the pixels that objects have a part in, else 0, and depth there, else +inf.

    Args:
        density: of F images, leaves (F, ...).
        layers_m: (n, h, w) depth of objects, each alone, +inf beside it.
        parts: (n,) of the images, in which each is seen; the lines beside what is in a part (`lines_around`)
            are in it, too, or beyond the image.
    """
    pixels = ObjectPixels.of(layers_m, parts.of(density.image.rest_m, layers_m.shape[1:]))
    objects = density.object_images(pixels, parts)
    size, count = layers_m.shape, layers_m.size
    order, number = sort_chosen_first(jnp.isfinite(pixels.shown_m).ravel())
    together = min(PIXELS_TOGETHER, count)
    order = jnp.pad(order, (0, -count % together))

    def in_parts(of_places: Callable[[Places], jax.Array], nothing: jax.Array) -> jax.Array:
        """Images (n, h, w) with values (P,) of all listed pixels."""

        def with_part(turn: jax.Array, values: jax.Array) -> jax.Array:
            first = turn * together
            numbers = jax.lax.dynamic_slice(order, (first,), (together,))
            listed = first + jnp.arange(together, dtype=jnp.int32) < number
            part = of_places(Places.of_numbers(numbers, size)).astype(values.dtype)
            return values.at[jnp.where(listed, numbers, count)].set(part, mode="drop")

        turns = -(-number // together)
        return jax.lax.fori_loop(0, turns, with_part, jnp.full(count, nothing)).reshape(size)

    badly = in_parts(partial(density.badly_foretold, objects.surfaces, parts), jnp.array(False))
    objects = replace(objects, surfaces=replace(objects.surfaces, badly_foretold=badly))
    log_density = in_parts(partial(density.log_factors, objects, parts), jnp.zeros((), layers_m.dtype))
    return log_density, pixels.shown_m
