"""Which lamp lights a scene: of a fixed set, how probable each is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scene.colour.density import laplace_evidence
from scene.colour.posterior import ColourImage, Scene, seen_together, segments_of
from scene.colour.rendering import render_with_normals
from scene.colour.world import Light, TableWorld

DIRECTIONS = 32
"""Spread over the upper half of the sphere, 25 degrees from each other: shades differ by a tenth."""
AMBIENTS = (0.2, 0.4, 0.6, 0.8)
EVENLY = 0.1
"""Share of a chain's proposals that takes any lamp."""
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


@dataclass(frozen=True, eq=False)
class LampShares:
    """Lamps that may light a scene, equally probable before the image is seen.

    Attributes:
        lights: (L,).
        log_shares: (L,) by what one scene says; a chain proposes by them.
    """

    lights: Sequence[Light]
    log_shares: NDArray[np.float64]

    @classmethod
    def known(cls, light: Light) -> LampShares:
        """One alone."""
        return cls([light], np.zeros(1))

    @classmethod
    def of(cls, world: TableWorld, image: ColourImage, scene: Scene) -> LampShares:
        """Of `lights` and the world's own, given a scene, by Laplace's evidence."""
        tried = [world.light, *lights()]
        layers, normals = render_with_normals(world, scene.kinds, scene.poses)
        tiled, things = len(tried), len(scene)
        every = replace(
            layers.of(np.tile(np.arange(things), tiled)),
            shade=np.concatenate([light.shade(normals) for light in tried]),
        )
        view = seen_together(world, every, np.repeat(np.arange(tiled), things))
        values = laplace_evidence(segments_of(world, image, view), world.noise)
        values = values.reshape(len(tried), len(scene)).sum(axis=1)
        shares = np.exp(values - np.logaddexp.reduce(values))
        return cls(tried, np.log((1 - EVENLY) * shares + EVENLY / len(tried)))

    @property
    def most_probable(self) -> Light:
        """Of them."""
        return self.lights[int(self.log_shares.argmax())]
