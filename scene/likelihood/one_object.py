"""Density of the observed depth when one object moves and everything else is held fixed.

A hypothesis of one object then costs only the pixels that this object covers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN, DepthNoise
from scene.execution import score_on_all_cores
from shapes import depth_noise
from shapes.geometry.camera import Camera
from shapes.rendering.object_library import ObjectLibrary
from shapes.rendering.ray_casting import PosedObjects
from shapes.rendering.tile_queue import for_each_block
from shapes.rendering.tiles import tile_counts, to_tiles
from shapes.stored_kernels import jit_stored

IMPOSSIBLE = -1e4
"""Log density of a pixel that the noise model excludes; finite, so that hypotheses stay comparable."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DepthEvidence:
    """I depth images against the rest of the scene: all that stands still while one object is moved.

    An image belongs to one frame of one camera, and to one chain where the chains' scenes differ.

    Attributes:
        cameras: leaves (I,).
        observed_m: (I * tiles, TILE_PIXELS), measured depth or `NO_RETURN`.
        rest_m: the same, rendered depth of the rest, +inf where there is nothing.
        log_density_of_rest: the same, log density of each pixel if the object covers it not.
        height: of the images.
        width: of the images.
    """

    cameras: Camera
    observed_m: jax.Array
    rest_m: jax.Array
    log_density_of_rest: jax.Array
    height: int = field(metadata={"static": True})
    width: int = field(metadata={"static": True})

    @property
    def tiles(self) -> int:
        """Tiles of an image."""
        down, across = tile_counts(self.height, self.width)
        return down * across


@jax.jit
def depth_evidence(
    noise: DepthNoise, cameras: Camera, observed_m: jax.Array, rest_m: jax.Array
) -> DepthEvidence:
    """Evidence of observed depth images against the rendered depth of the rest of the scene.

    Args:
        noise: of the sensor.
        cameras: leaves (I,).
        observed_m: (I, H, W); what is not finite and positive is no return.
        rest_m: (I, H, W); +inf where there is nothing. Broadcasts against `observed_m`.
    """
    observed_m, rest_m = jnp.broadcast_arrays(observed_m, rest_m)
    observed_m = jnp.where(jnp.isfinite(observed_m) & (observed_m > 0), observed_m, NO_RETURN)
    density = _log_density(noise, observed_m, rest_m)
    return DepthEvidence(
        cameras=cameras,
        observed_m=to_tiles(observed_m, NO_RETURN),
        rest_m=to_tiles(rest_m, 0.0),
        log_density_of_rest=to_tiles(density, 0.0),
        height=observed_m.shape[1],
        width=observed_m.shape[2],
    )


def log_likelihood_ratio(
    library: ObjectLibrary, noise: DepthNoise, evidence: DepthEvidence, posed: PosedObjects
) -> NDArray[np.float32]:
    """Log likelihood (N,) of each hypothesis's image when its object joins the rest, less that of the rest.

    The product over the image's pixels of the density of docs/model.md, section 0; base measure: Lebesgue in
    metres plus the atom of no return. For several frames or cameras, sum over a hypothesis's images.
    """
    return score_on_all_cores(partial(gain_over_rest, library, noise, evidence), posed)


@jit_stored()
def gain_over_rest(
    library: ObjectLibrary, noise: DepthNoise, evidence: DepthEvidence, posed: PosedObjects
) -> jax.Array:
    """The same in one kernel."""

    def add(
        total: jax.Array, view: jax.Array, tile: jax.Array, depth: jax.Array, valid: jax.Array
    ) -> jax.Array:
        row = posed.camera_index[view] * evidence.tiles + tile
        covers = depth < evidence.rest_m[row]
        density = _log_density(noise, evidence.observed_m[row], depth)
        gain = jnp.where(covers, density - evidence.log_density_of_rest[row], 0.0).sum(axis=1)
        return total.at[jnp.where(valid, view, len(total))].add(gain, mode="drop")

    zero = jnp.zeros(len(posed), jnp.float32)
    return for_each_block(library, posed, evidence.cameras, evidence.height, evidence.width, add, zero)


def _log_density(noise: DepthNoise, observed_m: jax.Array, rendered_m: jax.Array) -> jax.Array:
    return jnp.maximum(depth_noise.log_density(noise, observed_m, rendered_m), IMPOSSIBLE)
