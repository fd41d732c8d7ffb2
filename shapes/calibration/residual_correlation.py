"""How far errors of neighbouring pixels are alike, from residuals of windows, of which the fit takes a part.

With errors of covariance sigma^2 S and the projection H onto a window's quadratics the residuals' covariance
is sigma^2 (I - H) S (I - H). Long correlations lose most: of a short window's residuals they look shorter,
and sigma smaller. Lengths are those whose foretold correlations of residuals are nearest to the measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from recordings.sensor_profile import ResidualCorrelation
from shapes.calibration.smooth_windows import LAGS, quadratic_basis

SHORTEST_PX, INDEPENDENT_PX = 0.1, 0.3
"""Neighbours correlate by exp(-10) and by 0.04: errors of a shorter length count as independent."""
LONGEST_SHARE = 1 / 6
"""Of a window: errors that are alike over more of it are not told apart from the surface's own bend."""


@dataclass(frozen=True, kw_only=True)
class Correlated:
    """Correlated errors.

    Attributes:
        lengths: of their correlation.
        kept: share of their variance that windows' residuals keep.
    """

    lengths: ResidualCorrelation
    kept: float


def fitted_correlation(measured: NDArray[np.float64], side_px: int) -> Correlated:
    """The lengths under which residuals of windows have these correlations (2, LAGS) along rows, columns."""
    longest = LONGEST_SHARE * side_px

    def differences(lengths: NDArray[np.float64]) -> NDArray[np.float64]:
        foretold = residual_covariances(float(lengths[0]), float(lengths[1]), side_px)
        return (foretold[:, 1:] / foretold[:, :1] - measured).ravel()

    found = least_squares(
        differences, np.full(2, 0.3 * longest), bounds=(SHORTEST_PX, longest), diff_step=1e-2, xtol=1e-3
    )
    x_px, y_px = found.x.tolist()
    kept = float(residual_covariances(x_px, y_px, side_px)[0, 0])
    shown = [0.0 if length < INDEPENDENT_PX else length for length in (x_px, y_px)]
    return Correlated(lengths=ResidualCorrelation(x_px=shown[0], y_px=shown[1]), kept=kept)


def residual_covariances(x_px: float, y_px: float, side_px: int) -> NDArray[np.float64]:
    """Mean covariances (2, LAGS + 1) of residuals 0, 1, ... pixels apart, of errors of variance 1.

    Those have correlation exp(-|(dx / x_px, dy / y_px)|).
    """
    basis = quadratic_basis(side_px)
    rows, columns = np.divmod(np.arange(side_px**2), side_px)
    table = np.exp(-np.hypot(*np.meshgrid(np.arange(side_px) / x_px, np.arange(side_px) / y_px)))
    images = basis.T.reshape(-1, side_px, side_px)
    spread = np.stack([_convolved(image, table) for image in images]).reshape(len(images), -1).T
    inner = basis.T @ spread

    def mean(down: int, across: int) -> float:
        first = (rows >= down) & (columns >= across)
        second = (rows < side_px - down) & (columns < side_px - across)
        taken = (basis[first] * spread[second]).sum(1) + (spread[first] * basis[second]).sum(1)
        given = ((basis[first] @ inner) * basis[second]).sum(1)
        return float(table[down, across] - (taken - given).mean())

    lags = range(LAGS + 1)
    return np.array([[mean(0, lag) for lag in lags], [mean(lag, 0) for lag in lags]])


def _convolved(image: NDArray[np.float64], table: NDArray[np.float64]) -> NDArray[np.float64]:
    """An image with a symmetric kernel given by its quadrant, by FFT on twice the size."""
    side = len(image)
    wrapped = np.minimum(np.arange(2 * side), 2 * side - np.arange(2 * side))
    inside = wrapped < side
    kernel = np.where(np.outer(inside, inside), table[np.ix_(wrapped % side, wrapped % side)], 0.0)
    product = np.fft.rfft2(image, (2 * side, 2 * side)) * np.fft.rfft2(kernel)
    return np.fft.irfft2(product, (2 * side, 2 * side))[:side, :side]
