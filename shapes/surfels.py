"""Surfels: pieces of surface beside the voxels of a shape, placed finer than these can.

A voxel has one surfel for each side of the wall near it that was seen: two where a wall was seen from both
sides. A surfel is a plane n . (x - c) = offset about the voxel's centre c, with a Gaussian offset.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

SIDES = 2
"""Of a wall."""
STORED_AS = "surfel_"
"""What the names of its arrays in a shape's file begin with."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Surfels:
    """S surfels, in the order of their voxels, at most `SIDES` of one voxel.

    Attributes:
        voxel: (S,) int32, places in the raveled (I, J, K) grid.
        offset_m: (S,) float32, how far along the normal the surface lies from the voxel's centre; positive
            where the centre is beneath it.
        sigma_m: (S,) float32, standard deviation of the offset.
        normal: (S, 3) float32, unit, outward, in the grid frame.

    Raises:
        ValueError: shapes disagree, a value is not finite, a deviation is not positive, a normal has another
            length than 1, or the voxels are not in order.
    """

    voxel: NDArray[np.int32]
    offset_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    normal: NDArray[np.float32]

    def __post_init__(self) -> None:
        count = self.voxel.shape
        shapes = {"offset_m": count, "sigma_m": count, "normal": (*count, 3)}
        if len(count) != 1 or any(getattr(self, name).shape != shape for name, shape in shapes.items()):
            raise ValueError("surfels need one voxel, offset, deviation and normal each")
        if not all(np.isfinite(getattr(self, name)).all() for name in shapes):
            raise ValueError("a surfel has values that are not finite")
        if not (self.sigma_m > 0).all():
            raise ValueError("a surfel has a deviation that is not positive")
        if not np.allclose(np.linalg.norm(self.normal, axis=1), 1.0, atol=1e-3):
            raise ValueError("a surfel's normal is not of length 1")
        step = np.diff(self.voxel.astype(np.int64))
        if not (step >= 0).all() or (step[: 1 - SIDES] + step[SIDES - 1 :] == 0).any():
            raise ValueError(f"surfels are not in the order of voxels, at most {SIDES} each")

    def __len__(self) -> int:
        return len(self.voxel)

    @classmethod
    def none(cls) -> Surfels:
        """No surfel at all."""
        return cls(
            voxel=np.zeros(0, np.int32),
            offset_m=np.zeros(0, np.float32),
            sigma_m=np.zeros(0, np.float32),
            normal=np.zeros((0, 3), np.float32),
        )

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray]) -> Surfels:
        """What `arrays` gave; none where a file has none of them.

        Raises:
            KeyError: some of them are there and one is not.
            ValueError: they are no surfels.
        """
        if not any(name.startswith(STORED_AS) for name in arrays):
            return cls.none()
        kept: dict[str, Any] = {one.name: arrays[STORED_AS + one.name] for one in fields(cls)}
        voxel = kept.pop("voxel")
        if voxel.dtype.kind not in "iu":
            raise ValueError("surfels name their voxels by whole numbers")
        return cls(
            voxel=voxel.astype(np.int32, copy=False),
            **{name: values.astype(np.float32, copy=False) for name, values in kept.items()},
        )

    @property
    def arrays(self) -> dict[str, NDArray]:
        """Its arrays under the names that they have in a file."""
        return {STORED_AS + one.name: getattr(self, one.name) for one in fields(self)}

    def part(self, chosen: NDArray[np.bool_]) -> Surfels:
        """Those chosen (S,)."""
        return Surfels(**{one.name: getattr(self, one.name)[chosen] for one in fields(self)})

    def cropped(
        self, shape: tuple[int, int, int], low: NDArray[np.integer], high: NDArray[np.integer]
    ) -> Surfels:
        """Those in the voxels low <= (i, j, k) < high of a grid of this shape, numbered as in that part."""
        place = np.stack(np.unravel_index(self.voxel, shape), axis=1)
        inside = np.all((place >= low) & (place < high), axis=1)
        part = self.part(inside)
        moved = np.ravel_multi_index(tuple((place[inside] - low).T), tuple((high - low).tolist()))
        return replace(part, voxel=np.asarray(moved, np.int32))
