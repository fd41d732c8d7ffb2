"""Pixels of images in a list, and those beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike

Near = Callable[[int, int | jax.Array], jax.Array]
"""Values (P,) of the pixels so many rows above listed ones and columns to their left, one number or (P,); 0
beyond the border."""


@dataclass(frozen=True)
class Places:
    """P pixels of images (N, H, W), in any order.

    Attributes:
        image: (P,) int32.
        row: (P,) int32.
        column: (P,) int32.
    """

    image: jax.Array
    row: jax.Array
    column: jax.Array

    @classmethod
    def of_numbers(cls, numbers: jax.Array, size: tuple[int, ...]) -> Places:
        """Those of numbers (P,) in N images (N, H, W) of this size, one row after another."""
        _, height, width = size
        line, column = jnp.divmod(numbers, width)
        image, row = jnp.divmod(line, height)
        return cls(image, row, column)

    @classmethod
    def everywhere(cls, size: tuple[int, ...]) -> Places:
        """All pixels of images (H, W) of this size, one row after another; there is one image."""
        height, width = size
        return cls.of_numbers(jnp.arange(height * width, dtype=jnp.int32), (1, height, width))

    def of(self, images: jax.Array) -> jax.Array:
        """Values (..., P) of images (N, ..., H, W)."""
        _, *_, height, width = images.shape
        stacked = jnp.moveaxis(images, 0, -3)
        flat = stacked.reshape(*stacked.shape[:-3], -1)
        return flat.at[..., self._number(height, width)].get(mode="clip")

    def of_images(self, numbers: ArrayLike) -> jax.Array:
        """Of numbers (N, ...) of images those (..., P) of these pixels; (..., 1) where N is 1."""
        of_all = jnp.asarray(numbers)
        which = self.image if len(of_all) > 1 else jnp.zeros(1, jnp.int32)
        return jnp.moveaxis(of_all.at[which].get(mode="clip"), 0, -1)

    def beside(self, images: jax.Array) -> Near:
        """What is beside these pixels in images (N, H, W)."""
        _, height, width = images.shape
        flat, number = images.reshape(-1), self._number(height, width)

        def at(down: int, across: int | jax.Array) -> jax.Array:
            column = self.column - across
            inside = (self.row >= down) & (column >= 0) & (column < width)
            value = flat.at[number - (down * width + across)].get(mode="clip")
            return jnp.where(inside, value, jnp.zeros((), value.dtype))

        return at

    def _number(self, height: int, width: int) -> jax.Array:
        return (self.image * height + self.row) * width + self.column


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ImageParts:
    """Parts (N, h, w) of F images (F, H, W).

    Attributes:
        image: (N,) int32, of which.
        corner: (N, 2) int32 first row and column; None where each part is a whole image.
    """

    image: ArrayLike
    corner: ArrayLike | None = None

    def of(self, images: jax.Array, size: tuple[int, ...]) -> jax.Array:
        """Values (N, h, w) of images (F, H, W)."""
        if self.corner is None:
            return images[self.image]

        def part(image: jax.Array, corner: jax.Array) -> jax.Array:
            return jax.lax.dynamic_slice(images, (image, *corner), (1, *size))[0]

        return jax.vmap(part)(jnp.asarray(self.image), jnp.asarray(self.corner))

    def of_images(self, numbers: jax.Array) -> jax.Array:
        """Numbers (F,) of images, beside the pixels of the parts: (N, 1, 1)."""
        return numbers[self.image][:, None, None]

    def in_images(self, places: Places) -> Places:
        """Pixels of the parts as those of the images."""
        image = jnp.asarray(self.image).at[places.image].get(mode="clip")
        if self.corner is None:
            return Places(image, places.row, places.column)
        row, column = jnp.asarray(self.corner).at[places.image].get(mode="clip").T
        return Places(image, places.row + row, places.column + column)
