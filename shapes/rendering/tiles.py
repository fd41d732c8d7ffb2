"""Images cut into square tiles, the unit of work of rendering: a tile is one contiguous row of pixels."""

from __future__ import annotations

import jax
import jax.numpy as jnp

TILE = 4
"""Pixels along the edge of a tile."""

TILE_PIXELS = TILE * TILE


def tile_counts(height: int, width: int) -> tuple[int, int]:
    """Tiles that cover an image, down and across."""
    return -(-height // TILE), -(-width // TILE)


def to_tiles(images: jax.Array, fill: float) -> jax.Array:
    """Images (I, H, W) as rows of pixels (I * down * across, TILE_PIXELS); `fill` beyond the border."""
    count, height, width = images.shape
    down, across = tile_counts(height, width)
    border = ((0, 0), (0, down * TILE - height), (0, across * TILE - width))
    blocks = jnp.pad(images, border, constant_values=fill).reshape(count, down, TILE, across, TILE)
    return blocks.transpose(0, 1, 3, 2, 4).reshape(-1, TILE_PIXELS)


def from_tiles(rows: jax.Array, height: int, width: int) -> jax.Array:
    """Images (I, H, W) from rows of pixels (I * down * across, TILE_PIXELS)."""
    down, across = tile_counts(height, width)
    blocks = rows.reshape(-1, down, across, TILE, TILE).transpose(0, 1, 3, 2, 4)
    return blocks.reshape(-1, down * TILE, across * TILE)[:, :height, :width]
