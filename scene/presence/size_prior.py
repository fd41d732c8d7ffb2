"""How large an object is that is known: its shape and the camera's scale are known with some error.

Logs of half sizes are Normal about those of the shape, so that what stands there need not have the model's
size to the millimetre. What is round keeps one radius.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene.likelihood.pixel_density import SUPPORT_ERROR
from scene.objects.scene_object import SceneObject

ALONG = 0.9
"""Cosine to an axis of its box of the line about which an object is round, whose other axes have one size."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SizePrior:
    """The sizes of N objects.

    Attributes:
        log_half: (N, 3) of the shapes' boxes.
        sigma: (N, 3) standard deviations of the logs of half sizes.
        ties: (N, 3) for each axis of the box the first one whose size it follows.
    """

    log_half: NDArray[np.float64]
    sigma: NDArray[np.float64]
    ties: NDArray[np.intp]

    @classmethod
    def of(cls, objects: Sequence[SceneObject], surface_error_m: float) -> SizePrior:
        """The sizes of objects whose faces err by so much, opposite ones alike: cameras fatten things."""
        half_m = np.stack([one.half_extents_m for one in objects])
        ties = np.tile(np.arange(3), (len(objects), 1))
        for one, known in enumerate(objects):
            axis = int(np.abs(known.spin_line[0]).argmax())
            if abs(known.spin_line[0, axis]) > ALONG:
                first, second = np.delete(np.arange(3), axis)
                ties[one, second] = first
        sigma = np.hypot(SUPPORT_ERROR, surface_error_m / half_m)
        return cls(log_half=np.log(half_m), sigma=np.take_along_axis(sigma, ties, axis=1), ties=ties)

    def log_density(self, log_half: NDArray[np.float64], owners: NDArray[np.integer]) -> NDArray[np.float64]:
        """Log density (n, S) of logs of half sizes (n, S, 3) of objects `owners` (n,).

        Lebesgue measure of those that are free.
        """
        sigma, free = (part[owners][:, None] for part in (self.sigma, free_sizes(self.ties)))
        white = (log_half - self.log_half[owners][:, None]) / sigma
        log_each = -0.5 * white**2 - np.log(sigma) - 0.5 * math.log(2 * math.pi)
        return np.where(free, log_each, 0.0).sum(axis=-1)

    def tied(self, states: NDArray[np.float64], owners: NDArray[np.integer]) -> NDArray[np.float64]:
        """States (n, S, 10) of objects `owners` (n,) in which tied sizes change alike."""
        ties = self.ties[owners][:, None]
        change = states[..., 7:] - self.log_half[owners][:, None]
        change = np.take_along_axis(change, np.broadcast_to(ties, change.shape), axis=-1)
        return np.concatenate([states[..., :7], self.log_half[owners][:, None] + change], axis=-1)


def free_sizes(ties: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Which sizes (N, 3) follow no other one."""
    return ties == np.arange(3)
