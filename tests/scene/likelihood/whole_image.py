"""The density of what one object shows, at every pixel of its image: what lists of pixels are checked by."""

from dataclasses import replace

import jax
import numpy as np

from scene.likelihood.object_pixels import ObjectPixels
from scene.likelihood.pixel_density import PixelDensity
from scene.likelihood.pixel_places import ImageParts, Places


def of_object(density: PixelDensity, layer_m: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Log density (H, W) of the pixels that an object has a part in, and its depth there, else +inf.

    Args:
        density: of the image.
        layer_m: (H, W) depth of the object alone, +inf beside it.
    """
    one, everywhere, only = (
        density.stacked(),
        Places.everywhere(layer_m.shape),
        ImageParts(np.zeros(1, np.int32)),
    )
    pixels = ObjectPixels.of(layer_m[None], one.image.rest_m)
    objects = one.object_images(pixels, only)
    objects = replace(objects, surfaces=one.with_badly_foretold(objects.surfaces))
    return one.log_factors(objects, only, everywhere).reshape(layer_m.shape), pixels.shown_m[0]
