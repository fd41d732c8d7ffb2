"""What each view says of the voxels: sorted, and packed, for all views are held together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapes.voxel_grid import VoxelGrid

BAND_PITCHES = 1.0
"""Rays are kept this far on both sides of their surface."""
BAND_SIGMAS = 4.0
"""A ray is truncated to voxels within both distances of its surface."""
LEAST_ASSOCIATION = 0.02
"""Readings of less probability are left out."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewReadings:
    """What one view says of the grid's V voxels; of every view all are held, so it is packed.

    Attributes:
        before: (ceil(V / 8),) packed bits, voxels well before all surfaces there: a ray crosses them.
        hidden: (ceil(V / 8),) packed bits, voxels behind what was seen.
        crossed: (G,) int32, other voxels that a ray may have crossed.
        through: (G,) probabilities that it did.
        voxel: (N,) int32, the voxels in a surface's band, of which the rest is said, as `Readings` has it.
        behind_m: (N, 2).
        sigma_m: (N, 2).
        association: (N, 2).
        normal: (N, 3) unit, of the surface seen near each centre, in the grid frame; zero where none is near.
        column: (N,).
        row: (N,).
        depth_m: (N,) of the voxels' centres.
        plane_depth_m: (N,) depth of the support plane on the ray through each centre; +inf without one.
        eye_m: (3,) the camera in the grid frame.
        footprint: edge of a voxel in pixels.
    """

    before: NDArray[np.uint8]
    hidden: NDArray[np.uint8]
    crossed: NDArray[np.int32]
    through: NDArray[np.float32]
    voxel: NDArray[np.int32]
    behind_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    association: NDArray[np.float32]
    normal: NDArray[np.float32]
    column: NDArray[np.float32]
    row: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    plane_depth_m: NDArray[np.float32]
    eye_m: NDArray[np.float64]
    footprint: float

    @classmethod
    def of(
        cls,
        before: NDArray[np.bool_],
        behind: NDArray[np.bool_],
        voxel: NDArray[np.intp],
        readings: Mapping[str, NDArray],
        grid: VoxelGrid,
        **view: Any,
    ) -> ViewReadings:
        """The readings (M, ...) of voxels (M,), of which those far from every surface only say on which side.

        Args:
            before: (V,) voxels well before all surfaces.
            behind: (V,) voxels well behind them.
            voxel: the others that were read.
            readings: by name, as `Readings`, `normal` and `plane_depth_m`.
            grid: the voxels.
            view: what holds for all of the view.
        """
        behind_m, association = readings["behind_m"], readings["association"]
        measured = association > LEAST_ASSOCIATION
        band = band_m(readings["sigma_m"], grid)
        through = np.where(measured & (behind_m < -band), association, 0.0).max(axis=1)
        covered = np.where(measured & (behind_m > 0), association, 0.0).sum(axis=1) > 0.5
        hidden = behind.copy()
        hidden[voxel[covered]] = True
        gone = through > 0
        near = (measured & (np.abs(behind_m) <= band)).any(axis=1)
        return cls(
            before=np.packbits(before),
            hidden=np.packbits(hidden),
            crossed=voxel[gone].astype(np.int32),
            through=through[gone],
            voxel=voxel[near].astype(np.int32),
            **{name: values[near] for name, values in readings.items()},
            **view,
        )


def band_m(sigma_m: NDArray[np.float32], grid: VoxelGrid) -> NDArray[np.float32]:
    """Distances (N, 2) from a surface within which a ray through a voxel is kept."""
    return np.maximum(BAND_PITCHES * grid.pitch_m, BAND_SIGMAS * sigma_m)
