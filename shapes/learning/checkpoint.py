"""How far learning came, kept in a file: after a kill it goes on from there with the same numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapes.archive import load_fields, save_fields
from shapes.learning.occupancy import Occupancy

FORMAT_VERSION = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class LearnCheckpoint:
    """What the first D of the drawn trajectories say of all N voxels of the grid; fields as of `Occupancy`.

    Attributes:
        phi: (D, N).
        seen: (D, N).
        hidden: (D, N).
    """

    phi: NDArray[np.float64]
    seen: NDArray[np.bool_]
    hidden: NDArray[np.bool_]

    @classmethod
    def of(cls, found: Sequence[Occupancy]) -> LearnCheckpoint:
        """The checkpoint after these trajectories."""
        return cls(**{name: np.stack([getattr(one, name) for one in found]) for name in vars(found[0])})

    @property
    def found(self) -> list[Occupancy]:
        """One for each trajectory."""
        parts = zip(self.phi, self.seen, self.hidden, strict=True)
        return [Occupancy(phi=phi, seen=seen, hidden=hidden) for phi, seen, hidden in parts]

    def save(self, path: Path) -> None:
        """Write it, whole or not at all.

        Raises:
            OSError: the folder cannot be written.
        """
        save_fields(path, self, format_version=FORMAT_VERSION)

    @classmethod
    def load(cls, path: Path) -> LearnCheckpoint:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: there is none.
            ValueError: the file is damaged.
        """
        return cls(**load_fields(path, cls, format_version=FORMAT_VERSION, title="checkpoint of learning"))
