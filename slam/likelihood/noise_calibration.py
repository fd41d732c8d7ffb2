"""Calibrating the sensor on the recording itself: sigma over depth, and how many pixels count as one.

Both come from the residuals of frames that were found. Sigma: the mean squared residual in units of the
present sigma, by depth, each pixel weighed by its probability of being no outlier (one EM step a frame).
The exponent: the ratio of curvature to the variance of the score that blocks of pixels show (magnitude
adjustment of a composite likelihood; Ribatet, Cooley and Davison 2012), so that a tempered density is as
wide as the spread of its own optimum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recordings.types import DepthNoise
from shapes.depth_noise import standard_deviation

BIN_EDGES_M = np.asarray([0.0, 0.5, 0.8, 1.1, 1.4, 1.8, 2.2, 2.7, 3.3, 4.0, 6.0, 10.0])

LEARNING_FRAMES = 60
"""Frames after which the sensor is taken as known."""

PRIOR_PIXELS = 200.0
"""The initial sigma counts as this many pixels in every depth bin."""

LEAST_SIGMA_M = 2e-4
"""Numerical guard, below any depth camera's noise."""

EXPONENT_RANGE = (1e-3, 1.0)
"""From one independent pixel in a thousand to all of them."""


@dataclass(frozen=True, kw_only=True)
class NoiseCalibration:
    """Running estimates.

    Attributes:
        noise: with the present sigma.
        exponent: tempering of the image density.
        squared: (B,) sum over pixels of inlier probability times squared residual in m^2, by depth.
        count: (B,) sum of inlier probabilities.
        inflations: sum over frames of trace(H^-1 V) / 6.
        frames: how many were taken in.
        fixed_sigma: the user gave the sensor.
        fixed_exponent: the user gave the exponent.
    """

    noise: DepthNoise
    exponent: float
    squared: NDArray[np.float64]
    count: NDArray[np.float64]
    inflations: float = 0.0
    frames: int = 0
    fixed_sigma: bool
    fixed_exponent: bool

    @classmethod
    def initial(cls, noise: DepthNoise | None, exponent: float | None) -> NoiseCalibration:
        """Before the first frame; what is given stays as it is, but for a range that returns exceed."""
        bins = np.zeros(len(BIN_EDGES_M) - 1)
        return cls(
            noise=noise or DepthNoise(),
            exponent=exponent or 0.1,
            squared=bins,
            count=bins,
            fixed_sigma=noise is not None,
            fixed_exponent=exponent is not None,
        )

    @property
    def is_learning(self) -> bool:
        """Whether further frames change anything."""
        return self.frames < LEARNING_FRAMES and not (self.fixed_sigma and self.fixed_exponent)

    def reaching(self, depth_m: float) -> NoiseCalibration:
        """The same for a sensor that reaches so far: a return beyond its range would have no density."""
        reach = max(self.noise.max_range_m, depth_m)
        return replace(self, noise=replace(self.noise, max_range_m=reach))

    def after(
        self,
        squared_ratio: NDArray[np.float64],
        count: NDArray[np.float64],
        precision: NDArray[np.float64],
        score_variance: NDArray[np.float64],
    ) -> NoiseCalibration:
        """One frame more.

        Args:
            squared_ratio: (B,) sum of inlier probability times squared residual over its variance.
            count: (B,) sum of inlier probabilities.
            precision: (6, 6) Gauss-Newton curvature, exponent 1.
            score_variance: (6, 6) of the gradient.
        """
        centres = 0.5 * (BIN_EDGES_M[1:] + BIN_EDGES_M[:-1])
        present = standard_deviation(self.noise, centres) ** 2
        squared, total = self.squared + squared_ratio * present, self.count + count
        inflation = self.inflations + float(np.trace(np.linalg.pinv(precision) @ score_variance)) / 6
        frames = self.frames + 1
        noise = self.noise if self.fixed_sigma else _fitted(squared, total, centres, self.noise)
        exponent = self.exponent
        if not self.fixed_exponent:
            exponent = float(np.clip(frames / max(inflation, 1e-9), *EXPONENT_RANGE))
        return replace(
            self,
            noise=noise,
            exponent=exponent,
            squared=squared,
            count=total,
            inflations=inflation,
            frames=frames,
        )


def _fitted(
    squared: NDArray[np.float64], count: NDArray[np.float64], centres: NDArray[np.float64], noise: DepthNoise
) -> DepthNoise:
    """The noise whose sigma over depth fits the bins, weighed by their pixels; both terms stay positive."""
    default = DepthNoise()
    expected = standard_deviation(default, centres)
    shrunk = (squared + PRIOR_PIXELS * expected**2) / (count + PRIOR_PIXELS)
    sigma, weight = np.sqrt(shrunk), np.sqrt((count + PRIOR_PIXELS) / shrunk)
    rise = (expected - default.sigma_base_m) / default.sigma_growth_per_m
    design = np.stack([np.ones_like(centres), rise], axis=1)
    (base, growth), *_ = np.linalg.lstsq(design * weight[:, None], sigma * weight, rcond=None)
    if growth < 0:
        base, growth = float(np.average(sigma, weights=weight**2)), 0.0
    if base < LEAST_SIGMA_M:
        base = LEAST_SIGMA_M
        growth = max(float(np.average((sigma - base) / rise, weights=weight**2 * rise**2)), 0.0)
    return replace(noise, sigma_base_m=float(base), sigma_growth_per_m=float(growth))
