"""The parameters of the sensor density from windows of images, by expectation maximisation.

A window shows one smooth surface, with residuals of the sensor's sigma at its depth, or something else:
edges, bumps, several things. Of the first kind log sigma is Gaussian about the sensor's, as short windows
are; of the second it may be anything. Which is which is told by all windows together, so that objects,
clutter and bad windows do no harm as long as there are smooth parts (docs/model.md, section 0).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from recordings.sensor_profile import ResidualCorrelation
from recordings.types import DepthNoise
from shapes.calibration.residual_correlation import fitted_correlation
from shapes.calibration.smooth_windows import WindowResiduals
from shapes.depth_noise import standard_deviation

ITERATIONS = 40
OTHER_LOG_RANGE = 6.0
"""Windows of anything have log sigmas evenly over so wide a range: a factor of 400."""
LEAST_SPREAD, USUAL_SPREAD, SPREAD_WINDOWS = 0.05, 0.1, 10.0
"""Of log sigma among smooth windows; the usual one counts as so many."""
LEVEL_SD, GROWTH_SD = 0.7, 0.5
"""Of log sigma at 1 m, and of log growth over base, about the usual sensor's: images of one distance tell
nothing of others."""
MOST_WINDOWS = 50.0
"""As which more than so many windows count: what is not smooth about surfaces, they have in common."""
LEAST_SIGMA_M = 2e-4
"""Numerical guard, below any depth camera's noise: depths may be computed, and not measured."""
LEAST_BASE_M, LEAST_GROWTH = 1e-5, 1e-7
PRIOR_PIXELS = 1e3
"""As which the usual sensor's missing returns count."""
FEW_WINDOWS = 50
"""With fewer smooth windows sigma is known to a tenth at best."""
ASSURED = 0.5
"""Probability from which a window counts as smooth."""
FAR = 1.25
"""The range ends so many times as far as the farthest return."""


@dataclass(frozen=True, kw_only=True)
class NoiseEstimate:
    """What images tell of a sensor's noise.

    Attributes:
        noise: of the sensor density; that of missing returns where nothing is, is the usual one.
        correlation: of residuals.
        windows: smooth windows that told of it.
        depths_m: the nearest and farthest of them; 0 without any.
    """

    noise: DepthNoise
    correlation: ResidualCorrelation
    windows: float
    depths_m: tuple[float, float]


def estimate_noise(windows: WindowResiduals, usual: DepthNoise | None = None) -> NoiseEstimate:
    """The sensor's noise from windows of its images.

    Args:
        windows: of all images.
        usual: what is believed where they tell little.
    """
    usual = usual or DepthNoise()
    log_sigma = 0.5 * np.log(np.maximum(windows.square_m2, LEAST_SIGMA_M**2))
    smooth, noise = _mixture(log_sigma, windows.depth_m, usual)
    correlation, noise = _correlated(windows, smooth, noise)
    told = windows.depth_m[smooth > ASSURED]
    return NoiseEstimate(
        noise=replace(noise, **_rates(windows, smooth, usual)),
        correlation=correlation,
        windows=float(smooth.sum()),
        depths_m=(float(told.min()), float(told.max())) if len(told) else (0.0, 0.0),
    )


def _mixture(
    log_sigma: NDArray[np.float64], depth_m: NDArray[np.float64], usual: DepthNoise
) -> tuple[NDArray[np.float64], DepthNoise]:
    """Probability (n,) that windows are smooth, and the noise of those.

    Begins with the quarter of the windows that is calmest beside the usual sensor: bumps and edges only add.
    """
    smooth = np.ones(len(log_sigma))
    if not len(log_sigma):
        return smooth, usual
    beside = log_sigma - np.log(standard_deviation(usual, depth_m))
    noise, spread, share = _scaled(usual, float(np.exp(np.quantile(beside, 0.25)))), 0.3, 0.5
    for _ in range(ITERATIONS):
        error = log_sigma - np.log(standard_deviation(noise, depth_m))
        likely = share * np.exp(-0.5 * (error / spread) ** 2) / (spread * np.sqrt(2 * np.pi))
        smooth = likely / (likely + (1 - share) / OTHER_LOG_RANGE)
        noise = _fitted(log_sigma, depth_m, smooth, noise, usual)
        error = log_sigma - np.log(standard_deviation(noise, depth_m))
        squares = (smooth * error**2).sum() + SPREAD_WINDOWS * USUAL_SPREAD**2
        spread = max(float(np.sqrt(squares / (smooth.sum() + SPREAD_WINDOWS))), LEAST_SPREAD)
        share = float(np.clip(smooth.mean(), 0.01, 0.99))
    return smooth, noise


def _fitted(
    log_sigma: NDArray[np.float64],
    depth_m: NDArray[np.float64],
    weight: NDArray[np.float64],
    start: DepthNoise,
    usual: DepthNoise,
) -> DepthNoise:
    """The noise whose log sigma over depth is nearest to the windows', and to the usual one's beside."""
    counted = weight * min(1.0, MOST_WINDOWS / max(float(weight.sum()), 1e-9))

    def level_and_growth(noise: DepthNoise) -> NDArray[np.float64]:
        at_1_m = standard_deviation(noise, np.ones(1))[0]
        return np.log([at_1_m, noise.sigma_growth_per_m / noise.sigma_base_m])

    def misfit(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        base, growth = np.exp(parameters).tolist()
        noise = replace(usual, sigma_base_m=base, sigma_growth_per_m=growth)
        error = (np.log(standard_deviation(noise, depth_m)) - log_sigma) / USUAL_SPREAD
        beside = (level_and_growth(noise) - level_and_growth(usual)) / [LEVEL_SD, GROWTH_SD]
        return np.concatenate([np.sqrt(counted) * error, beside])

    begin = np.log([start.sigma_base_m, start.sigma_growth_per_m])
    bounds = np.log([LEAST_BASE_M, LEAST_GROWTH]), np.log([1.0, 10.0])
    base, growth = np.exp(least_squares(misfit, np.clip(begin, *bounds), bounds=bounds).x).tolist()
    return replace(usual, sigma_base_m=base, sigma_growth_per_m=growth)


def _correlated(
    windows: WindowResiduals, smooth: NDArray[np.float64], noise: DepthNoise
) -> tuple[ResidualCorrelation, DepthNoise]:
    """Lengths of the correlation, and the noise with what the fit of surfaces took away of its variance."""
    if smooth.sum() < 1:
        return ResidualCorrelation(x_px=0.0, y_px=0.0), noise
    measured = np.tensordot(smooth, windows.correlation, 1) / smooth.sum()
    found = fitted_correlation(measured, windows.side_px)
    return found.lengths, _scaled(noise, float(1 / np.sqrt(found.kept)))


def _rates(windows: WindowResiduals, smooth: NDArray[np.float64], usual: DepthNoise) -> dict[str, float]:
    """Outliers among returns of smooth windows, small holes among pixels that see something, and the range.

    Outliers that hang together, as at edges, look like surfaces: there are as many as usual at least.
    """
    assured = smooth > ASSURED
    returned, off = float(windows.returned[assured].sum()), float(windows.off[assured].sum())
    holes, seen = float(windows.holes), float(windows.holes + windows.measured)
    return {
        "outlier_probability": max(off / max(returned, 1.0), usual.outlier_probability),
        "none_hit_probability": (holes + PRIOR_PIXELS * usual.none_hit_probability) / (seen + PRIOR_PIXELS),
        "max_range_m": max(usual.max_range_m, round(FAR * windows.farthest_m, 1)),
    }


def _scaled(noise: DepthNoise, factor: float) -> DepthNoise:
    return replace(
        noise,
        sigma_base_m=max(factor * noise.sigma_base_m, LEAST_BASE_M),
        sigma_growth_per_m=max(factor * noise.sigma_growth_per_m, LEAST_GROWTH),
    )
