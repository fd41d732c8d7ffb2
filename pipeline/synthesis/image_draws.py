"""Images drawn from the density by which scenes are compared, pixel after pixel in raster order."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise
from scene.likelihood.causal_planes import WIDE_PX
from scene.likelihood.object_pixels import ObjectPixels
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.pixel_places import Places
from scene.likelihood.unknown_surfaces import UnknownWeights

REACH_PX = WIDE_PX + 1
"""Rows above and columns beside a pixel on which its factor depends: whether one beside it was badly foretold
is told by the planes through the pixels before that one."""


def drawn_image(
    key: jax.Array,
    layers_m: NDArray[np.float32],
    rest_m: NDArray[np.float32],
    noise: DepthNoise,
    shape_sigma_m: float,
    edge_reach: float,
    learned: UnknownWeights,
) -> NDArray[np.float32]:
    """An image (H, W) of a scene, `NO_RETURN` where nothing was measured: 1 ms a pixel.

    Each pixel is drawn in a patch that holds all that its factor looks at.

    Args:
        key: random key.
        layers_m: (L, H, W) depth of each object alone, +inf beside it; one at least.
        rest_m: (H, W) of the supports, +inf where none is.
        noise: of the sensor.
        shape_sigma_m: error of objects' surfaces.
        edge_reach: as `PixelDensity` has it.
        learned: how well pixels foretell each other.
    """
    numbers = noise, shape_sigma_m, edge_reach, learned
    with jax.enable_x64(False):
        return np.asarray(_drawn_image(key, layers_m, rest_m, *jax.tree.map(np.float32, numbers)))


@jax.jit
def _drawn_image(
    key: jax.Array,
    layers_m: jax.Array,
    rest_m: jax.Array,
    noise: DepthNoise,
    shape_sigma_m: jax.Array,
    edge_reach: jax.Array,
    learned: UnknownWeights,
) -> jax.Array:
    """The same, of float32."""
    height, width = rest_m.shape
    pixels = ObjectPixels.of(layers_m, rest_m[None])
    nearest = jnp.argmin(pixels.shown_m, axis=0)
    sides = (REACH_PX, 0), (REACH_PX, REACH_PX)
    rest_m = jnp.pad(rest_m, sides, constant_values=jnp.inf)

    def padded(leaf: jax.Array) -> jax.Array:
        outside = False if leaf.dtype == bool else jnp.inf
        return jnp.pad(leaf, ((0, 0), *sides), constant_values=outside)

    pixels = jax.tree.map(padded, pixels)
    last = Places(*jnp.array([[0], [REACH_PX], [REACH_PX]], jnp.int32))

    def with_drawn(number: jax.Array, observed_m: jax.Array) -> jax.Array:
        row, column = number // width, number % width

        def patch(image: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice(image, (row, column), (REACH_PX + 1, 2 * REACH_PX + 1))

        density = PixelDensity.of_image(
            patch(observed_m), patch(rest_m), noise, shape_sigma_m, edge_reach, learned
        )
        mine = jax.tree.map(lambda leaf: patch(leaf[nearest[row, column]])[None], pixels)
        (drawn_m,) = density.drawn(jax.random.fold_in(key, number), mine, last)
        return observed_m.at[row + REACH_PX, column + REACH_PX].set(drawn_m)

    blank = jnp.full(rest_m.shape, NO_RETURN, rest_m.dtype)
    drawn_m = jax.lax.fori_loop(0, height * width, with_drawn, blank)
    return drawn_m[REACH_PX:, REACH_PX:-REACH_PX]
