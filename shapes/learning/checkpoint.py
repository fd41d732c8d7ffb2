"""How far learning came, kept in a file: after a kill it goes on from there with the same numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from shapes.archive import Archived
from shapes.learning.occupancy import Occupancy
from shapes.surfels import Surfels

MASKS = ("phi", "seen", "hidden")


@dataclass(frozen=True, kw_only=True, eq=False)
class LearnCheckpoint(Archived):
    """What the first D of the drawn trajectories say of all N voxels of the grid; fields as of `Occupancy`.

    Attributes:
        phi: (D, N).
        seen: (D, N).
        hidden: (D, N).
        surfel_counts: (D,) how many of the S surfels are of each.
        surfel_voxel, surfel_offset_m, surfel_sigma_m: (S,) as of `Surfels`.
        surfel_normal: (S, 3).
    """

    FORMAT_VERSION: ClassVar[int] = 2
    TITLE: ClassVar[str] = "checkpoint of learning"
    phi: NDArray[np.float64]
    seen: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    surfel_counts: NDArray[np.int64]
    surfel_voxel: NDArray[np.int32]
    surfel_offset_m: NDArray[np.float32]
    surfel_sigma_m: NDArray[np.float32]
    surfel_normal: NDArray[np.float32]

    @classmethod
    def of(cls, found: Sequence[Occupancy]) -> LearnCheckpoint:
        """The checkpoint after these trajectories."""
        each = [one.surfels.arrays for one in found]
        return cls(
            **{name: np.stack([getattr(one, name) for one in found]) for name in MASKS},
            **{name: np.concatenate([arrays[name] for arrays in each]) for name in each[0]},
            surfel_counts=np.array([len(one.surfels) for one in found], np.int64),
        )

    @property
    def found(self) -> list[Occupancy]:
        """One for each trajectory."""
        names = Surfels.none().arrays
        ends = np.cumsum(self.surfel_counts)[:-1]
        parts = {name: np.split(getattr(self, name), ends) for name in names}
        return [
            Occupancy(
                **{name: getattr(self, name)[one] for name in MASKS},
                surfels=Surfels.of_arrays({name: split[one] for name, split in parts.items()}),
            )
            for one in range(len(self.phi))
        ]
