"""Scenes weighed against each other: by density, and by the evidence of their number and kinds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.colour.density import laplace_evidence
from scene.colour.posterior import ColourImage, Scene, rendered_together, seen_together, segments_of
from scene.colour.world import TableWorld


@dataclass(frozen=True, eq=False)
class Weighed:
    """A scene with its evidence.

    Attributes:
        scene: the things.
        covariance: (N, 3, 3) of their poses, by curvature, each thing alone.
        log_density: `log_posterior`, by Laplace while the search goes on.
        log_evidence: of its number and kinds, by Laplace: density times the volume under the Gaussian.
    """

    scene: Scene
    covariance: NDArray[np.float64]
    log_density: float
    log_evidence: float


@dataclass(frozen=True, eq=False)
class FoundScene:
    """What one image says.

    Attributes:
        best: the scene of the greatest evidence.
        kinds: probabilities of the kinds of things there, ascending, over the scenes that the search weighed.
        count: (most + 1,) of each number of things, likewise.
        weighed: the best scene of each number and kinds.
    """

    best: Weighed
    kinds: Mapping[tuple[int, ...], float]
    count: NDArray[np.float64]
    weighed: tuple[Weighed, ...]


Posed = tuple[Scene, NDArray[np.float64]]
"""A scene and the covariances (N, 3, 3) of its poses."""


def laplace_gains(world: TableWorld, image: ColourImage, scenes: Sequence[Scene]) -> NDArray[np.float64]:
    """Log likelihoods (S,) against the empty table, by Laplace."""
    layers, owner = rendered_together(world, scenes)
    view = seen_together(world, layers, owner)
    segments = segments_of(world, image, view)
    table = np.concatenate([[0], np.cumsum(image.table[layers.pixel[view.leads]])])
    gains = laplace_evidence(segments, world.noise) - np.diff(table[segments.start])
    return np.asarray(np.bincount(owner, gains, minlength=len(scenes)), np.float64)


def weighed_scene(
    world: TableWorld, scene: Scene, covariance: NDArray[np.float64], log_density: float
) -> Weighed:
    """With the volume (Laplace 1774) of the poses under their Gaussians (N, 3, 3)."""
    turns = world.turns[scene.kinds]
    volume = 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1].sum() + np.log(np.maximum(turns, 1)).sum()
    return Weighed(scene, covariance, log_density, log_density + float(volume))
