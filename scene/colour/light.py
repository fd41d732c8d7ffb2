"""Which lamp lights a scene: of a fixed set, the one under which its image is most probable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scene.colour.posterior import ColourImage, Scene, log_likelihood
from scene.colour.world import Light, TableWorld

DIRECTIONS = 32
"""Spread over the upper half of the sphere, 25 degrees from each other: shades differ by a tenth."""
AMBIENTS = (0.2, 0.4, 0.6, 0.8)
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


def lights() -> list[Light]:
    """Every direction of a Fibonacci lattice with every share of ambient light."""
    number = np.arange(DIRECTIONS)
    up = (number + 0.5) / DIRECTIONS
    across, turn = np.sqrt(1 - up**2), number * GOLDEN_ANGLE
    directions = np.column_stack([across * np.cos(turn), across * np.sin(turn), up])
    return [
        Light(direction=(float(x), float(y), float(z)), ambient=ambient)
        for x, y, z in directions
        for ambient in AMBIENTS
    ]


def most_probable_light(world: TableWorld, image: ColourImage, scene: Scene) -> Light:
    """Of `lights` and the world's own, that under which the scene explains the image best."""
    tried = [world.light, *lights()]
    values = [log_likelihood(replace(world, light=light), image, scene) for light in tried]
    return tried[int(np.argmax(values))]
