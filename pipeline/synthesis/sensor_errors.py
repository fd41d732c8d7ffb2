"""What real depth cameras do beyond independent noise: correlated residuals, clustered holes.

Measured on real frames (structured light, tables at 0.7 to 1.2 m): residuals of neighbouring pixels correlate
by 0.9, 0.7 and 0.6 at one, two and three pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray


def correlated_normals(
    key: jax.Array, shape: tuple[int, int], correlation: Sequence[float]
) -> NDArray[np.float32]:
    """Standard normal pixels (H, W) with given correlations at 1, 2, ... pixels in all directions.

    Beyond the last one they fall by the last ratio, and between whole pixels they are interpolated. Drawn by
    the circulant embedding of the image in one twice as large (Dietrich and Newsam 1997); where the numbers
    are no covariance, the nearest that is one in its spectrum.
    """
    if not correlation:
        return np.asarray(jax.random.normal(key, shape), np.float32)
    root = np.sqrt(_spectrum(shape, tuple(correlation)))
    height, width = root.shape
    white = np.asarray(jax.random.normal(key, (2, height, width)))
    field = np.fft.fft2(root * (white[0] + 1j * white[1])).real / np.sqrt(height * width)
    return field[: shape[0], : shape[1]].astype(np.float32)


def clustered(key: jax.Array, shape: tuple[int, int], share: float, size_px: float) -> NDArray[np.bool_]:
    """Pixels (H, W) of which a share is set, in blots of about a size."""
    if share <= 0:
        return np.zeros(shape, bool)
    ratio = float(np.exp(-1 / size_px))
    field = correlated_normals(key, shape, (ratio,))
    return field > float(jax.scipy.stats.norm.ppf(jnp.asarray(1 - share)))


def _spectrum(shape: tuple[int, int], correlation: tuple[float, ...]) -> NDArray[np.float64]:
    """Variances of the Fourier modes of an image twice as large, of unit variance a pixel."""
    height, width = 2 * shape[0], 2 * shape[1]
    rows, columns = np.minimum(np.arange(height), height - np.arange(height)), np.arange(width)
    columns = np.minimum(columns, width - columns)
    distance = np.hypot(rows[:, None], columns[None, :])
    known = np.array([1.0, *correlation])
    reach = np.arange(len(known))
    ratio = known[-1] / known[-2]
    beyond = known[-1] * ratio ** (distance - reach[-1])
    covariance = np.where(distance <= reach[-1], np.interp(distance, reach, known), beyond)
    spectrum = np.maximum(np.fft.fft2(covariance).real, 0.0)
    return spectrum / spectrum.mean()
