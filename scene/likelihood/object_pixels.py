"""The pixels of an image that an object has a part in."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from scene.likelihood.causal_planes import LEANING_PX

JUST_BEFORE, FAR_M = 1 - 1e-6, 1e6
"""What an object does to the pixels beside it is behind all objects and before the supports."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ObjectPixels:
    """The pixels that an object has a part in, whatever is measured there; leaves (..., H, W).

    Attributes:
        covers: where it is nearer than the supports.
        inner: those of them at its outline.
        outer: those beside its outline.
        wide_m: its depth, and beside it that of the nearest pixel of its outline; +inf elsewhere.
        shown_m: its depth; of the pixels beside it, which tell that no unknown surface goes on from it,
            just before the supports, so that other objects hide them.
    """

    covers: jax.Array
    inner: jax.Array
    outer: jax.Array
    wide_m: jax.Array
    shown_m: jax.Array

    @classmethod
    def of(cls, layer_m: jax.Array, rest_m: jax.Array) -> ObjectPixels:
        """Of depth (..., H, W) of an object alone, +inf beside it, before supports of depth (..., H, W)."""
        covers = layer_m < rest_m
        layer_m = jnp.where(covers, layer_m, jnp.inf)
        nearest_m = functools.reduce(jnp.minimum, _four_beside(layer_m, jnp.inf))
        wide_m = jnp.where(covers, layer_m, jnp.where(nearest_m < rest_m, nearest_m, jnp.inf))
        just_before = jnp.where(jnp.isfinite(rest_m), rest_m * JUST_BEFORE, FAR_M)
        touches = jnp.isfinite(wide_m)
        shown_m = jnp.where(covers, layer_m, jnp.where(_touched_before(touches), just_before, jnp.inf))
        return cls(covers, covers & ~all_beside(covers), touches & ~covers, wide_m, shown_m)


def all_beside(mask: jax.Array) -> jax.Array:
    """Whether a mask (..., H, W) holds the four pixels beside each; what is beyond the border is held."""
    return functools.reduce(jnp.logical_and, _four_beside(mask, True))


def _touched_before(touches: jax.Array) -> jax.Array:
    """Where a mask (..., H, W) holds a pixel, the one to its left, that above or one to the right of that."""
    height, width = touches.shape[-2:]
    sides = [(0, 0)] * (touches.ndim - 2) + [(1, 0), (1, LEANING_PX)]
    wide = jnp.pad(touches, sides)
    touched = touches | wide[..., 1:, :width]
    for across in range(LEANING_PX + 1):
        touched |= wide[..., :height, 1 + across : 1 + across + width]
    return touched


def _four_beside(image: jax.Array, outside: float | bool) -> tuple[jax.Array, ...]:
    """The pixels (..., H, W) above, below, to the left and to the right of each."""
    sides = [(0, 0)] * (image.ndim - 2) + [(1, 1), (1, 1)]
    wide = jnp.pad(image, sides, constant_values=outside)
    return wide[..., :-2, 1:-1], wide[..., 2:, 1:-1], wide[..., 1:-1, :-2], wide[..., 1:-1, 2:]
