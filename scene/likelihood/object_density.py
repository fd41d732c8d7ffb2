"""What one object shows in an image, computed where the object is and not elsewhere.

`PixelDensity.of_object` looks at every pixel of the image, of which most objects cover a small part. A crop
that holds the object and the pixels on which its factors depend gives the same numbers.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp

from scene.likelihood.pixel_density import PixelDensity

CROPS = (36, 48), (72, 96)
"""Pixels of crops; the first holds nearly all objects with what is beside them. What fits none is not cut."""
MARGIN_PX = 5
"""The factors of pixels up to two beside an object look at pixels up to three further on."""


def object_density(
    density: PixelDensity, layer_m: jax.Array, rest_m: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """What `PixelDensity.of_object` gives where its depth is finite; elsewhere a log density of 0.

    Batched by `jax.lax.map`, not by `vmap`, under which all ways are computed for all.

    Args:
        density: of the image.
        layer_m: (H, W) depth of the object alone, +inf beside it.
        rest_m: (H, W) of the supports.
    """
    covers = jnp.isfinite(layer_m)
    bounds = []
    for axis, length in enumerate(layer_m.shape):
        lines = jnp.any(covers, axis=1 - axis)
        first, after = jnp.argmax(lines), length - jnp.argmax(lines[::-1])
        bounds.append((jnp.maximum(first - MARGIN_PX, 0), jnp.minimum(after + MARGIN_PX, length)))

    def nothing() -> tuple[jax.Array, jax.Array]:
        return jnp.zeros_like(layer_m), jnp.full_like(layer_m, jnp.inf)

    def shown(density: PixelDensity, layer_m: jax.Array, rest_m: jax.Array) -> tuple[jax.Array, jax.Array]:
        log_density, depth_m = density.of_object(layer_m, rest_m)
        log_density = jnp.where(jnp.isfinite(depth_m), log_density, 0.0)
        return log_density.astype(layer_m.dtype), depth_m

    def cropped(size: tuple[int, int]) -> tuple[jax.Array, jax.Array]:
        starts = [
            jnp.minimum(first, length - edge).astype(jnp.int32)
            for (first, _), edge, length in zip(bounds, size, layer_m.shape, strict=True)
        ]

        def cut(image: jax.Array) -> jax.Array:
            start = (*[jnp.int32(0)] * (image.ndim - 2), *starts)
            return jax.lax.dynamic_slice(image, start, (*image.shape[:-2], *size))

        unknown = density.unknown
        part = replace(
            density,
            observed_m=cut(density.observed_m),
            unknown=replace(
                unknown,
                means_m=cut(unknown.means_m),
                sigmas_m=cut(unknown.sigmas_m),
                weights=cut(unknown.weights),
            ),
        )
        log_density, depth_m = shown(part, cut(layer_m), cut(rest_m))
        put, (no_density, no_depth) = jax.lax.dynamic_update_slice, nothing()
        return put(no_density, log_density, starts), put(no_depth, depth_m, starts)

    height, width = layer_m.shape
    down, across = (after - first for first, after in bounds)
    smaller = [size for size in CROPS if size[0] < height and size[1] < width]
    way = 1 + sum(((down > size[0]) | (across > size[1])).astype(jnp.int32) for size in smaller)
    crops = [partial(cropped, size) for size in (*smaller, (height, width))]
    return jax.lax.switch(jnp.where(jnp.any(covers), way, 0), (nothing, *crops))
