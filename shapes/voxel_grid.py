"""The voxel grid on which a shape is learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True, eq=False)
class VoxelGrid:
    """A grid of voxels posed in the reference frame; its k axis points up where it stands on a plane.

    Attributes:
        shape: number of voxels along each axis.
        pitch_m: edge of a voxel.
        reference_from_grid: (4, 4) rigid.
        on_plane: the grid's plane z = 0 is a surface that ends every ray.
    """

    shape: tuple[int, int, int]
    pitch_m: float
    reference_from_grid: NDArray[np.float64]
    on_plane: bool

    def __len__(self) -> int:
        """Number of voxels."""
        return int(np.prod(self.shape))

    @property
    def centres_m(self) -> NDArray[np.float64]:
        """Centres (I J K, 3) in the grid frame, in the order of a raveled (I, J, K) array."""
        indices = np.stack(np.meshgrid(*map(np.arange, self.shape), indexing="ij"), axis=-1)
        return np.asarray((indices.reshape(-1, 3) + 0.5) * self.pitch_m, np.float64)

    def cropped(self, low: NDArray[np.integer], high: NDArray[np.integer]) -> VoxelGrid:
        """The voxels low <= (i, j, k) < high, with the frame moved to the first of them."""
        pose = self.reference_from_grid.copy()
        pose[:3, 3] += pose[:3, :3] @ (low * self.pitch_m)
        i, j, k = (int(n) for n in high - low)
        return VoxelGrid(
            shape=(i, j, k),
            pitch_m=self.pitch_m,
            reference_from_grid=pose,
            on_plane=self.on_plane and int(low[2]) == 0,
        )
