"""Gaussian kernels round poses: proposals near where heavy draws were found (population Monte Carlo)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

SIGMA_M, SIGMA_RAD = 0.005, 0.1
"""Of a kernel of scale 1: the sensor's noise, and what moves the rim of a hand-held object so far."""

SCALES = 0.4, 1.0, 2.5
"""Of the kernels in turn: what explains several points is narrower. Search effort; any are right."""

REACH_SIGMAS = 12.0
"""To which a kernel reaches in its place: what lies beyond is e^-72 of its top."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseKernels:
    """A mixture of equal shares.

    Attributes:
        centres: (J, 4, 4) world_from_box.
    """

    centres: NDArray[np.float64]

    def draw(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Poses (count, 4, 4)."""
        chosen = rng.integers(len(self.centres), size=count)
        scale = self._scales()[chosen, None]
        poses = self.centres[chosen].copy()
        poses[:, :3, 3] += scale * SIGMA_M * rng.standard_normal((count, 3))
        turns = Rotation.from_rotvec(scale * SIGMA_RAD * rng.standard_normal((count, 3)))
        poses[:, :3, :3] = poses[:, :3, :3] @ turns.as_matrix()
        return poses

    def log_density(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log density (n,) at poses (n, 4, 4), Lebesgue in metres times the Haar measure of mass pi^2.

        -inf where no kernel reaches.

        That measure is (sin(t/2) / (t/2))^2 / 8 times Lebesgue on rotation vectors of length t. No kernel is
        so wide that it reaches half a turn.
        """
        scales, places_m = self._scales(), self.centres[:, :3, 3]
        squares = cdist(poses[:, :3, 3], places_m, "sqeuclidean") / (scales * SIGMA_M) ** 2
        pose, kernel = np.nonzero(squares < REACH_SIGMAS**2)
        scales, squares = scales[kernel], squares[pose, kernel]
        cosines = np.einsum("nij,nij->n", poses[pose, :3, :3], self.centres[kernel, :3, :3])
        angles = np.arccos(np.clip((cosines - 1) / 2, -1.0, 1.0))
        turns = angles / (scales * SIGMA_RAD)
        log_normal = -0.5 * (squares + turns**2) - 3 * np.log(2 * np.pi)
        log_volume = 3 * np.log(scales**2 * SIGMA_M * SIGMA_RAD)
        log_measure = np.log(8) - 2 * np.log(np.sinc(angles / (2 * np.pi)))
        terms = np.exp(log_normal - log_volume + log_measure)
        with np.errstate(divide="ignore"):
            return np.log(np.bincount(pose, terms, len(poses)) / len(self.centres))

    def _scales(self) -> NDArray[np.float64]:
        """(J,) of the kernels."""
        return np.resize(SCALES, len(self.centres))
