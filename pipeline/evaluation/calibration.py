"""Whether probabilities of voxels mean what they say (docs/model.md, section C)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CLIP = 1e-3
PRESENCE_BINS = 10
"""Of the probability that an object is there, equally wide (Guo et al. 2017, expected calibration error)."""

BINS = 15


@dataclass(frozen=True, kw_only=True)
class VoxelCalibration:
    """Scores of probabilities against what was true; lower is better.

    Attributes:
        brier: mean squared error.
        log_loss: mean, in nats, of probabilities clipped to [1e-3, 1 - 1e-3].
        ece: expected calibration error over 15 bins of equal width.
        count: number of voxels.
    """

    brier: float
    log_loss: float
    ece: float
    count: int


def calibration(phi: NDArray[np.floating], truth: NDArray[np.bool_]) -> VoxelCalibration:
    """Scores of probabilities (N,) against truth (N,); NaN where there is none."""
    if len(phi) == 0:
        return VoxelCalibration(brier=np.nan, log_loss=np.nan, ece=np.nan, count=0)
    phi = np.clip(np.asarray(phi, np.float64), CLIP, 1 - CLIP)
    return VoxelCalibration(
        brier=float(np.mean((phi - truth) ** 2)),
        log_loss=float(-np.mean(np.where(truth, np.log(phi), np.log1p(-phi)))),
        ece=expected_calibration_error(phi, truth),
        count=len(phi),
    )


def expected_calibration_error(
    phi: NDArray[np.floating], truth: NDArray[np.bool_], bins: int = BINS
) -> float:
    """Mean over outcomes (N,) of how far their bin's probability is from its share (Naeini et al. 2015)."""
    gaps = [count * abs(said - found) for said, found, count in reliability(phi, truth, bins)]
    return float(sum(gaps) / len(phi))


def reliability(
    phi: NDArray[np.floating], truth: NDArray[np.bool_], bins: int = BINS
) -> list[tuple[float, float, int]]:
    """Mean probability, share that was true, and number of outcomes of each bin that holds some."""
    cell = np.minimum((phi * bins).astype(int), bins - 1)
    return [
        (float(phi[cell == one].mean()), float(truth[cell == one].mean()), int((cell == one).sum()))
        for one in np.unique(cell)
    ]
