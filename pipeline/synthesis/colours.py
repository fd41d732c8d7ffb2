"""Colours of synthetic things: flat RGB in 0..255."""

from __future__ import annotations

import hashlib

import numpy as np

Colour = tuple[int, int, int]


def shape_colour(shape: str, turn_rad: float = 0.0) -> Colour:
    """The saturated colour of a shape, the same in every film: its hue is drawn by the name alone.

    Args:
        shape: its name.
        turn_rad: by so much round the circle of hues the colour is another.
    """
    digest = hashlib.sha256(shape.encode()).digest()
    turn = 2 * np.pi * int.from_bytes(digest[:4]) / 2**32 + turn_rad
    red, green, blue = (int(value) for value in 140 + 95 * np.cos(turn + np.array([0, 2, 4]) * np.pi / 3))
    return red, green, blue


def muted_colour(rng: np.random.Generator) -> Colour:
    """A random colour of low saturation."""
    red, green, blue = (int(value) for value in rng.uniform(70, 215) + rng.uniform(-35, 35, size=3))
    return red, green, blue
