"""The result of the search: the best scene, and the pools that it was chosen from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scene.objects.slots import FoundObjects


@dataclass(frozen=True, kw_only=True, eq=False)
class BoltzmannAtoms:
    """Poses of N objects from masks, told by the image alone: no object's present pose decides them.

    Attributes:
        poses: (N, A, 7) camera_from_box.
        log_weights: (N, A), normalised over A; -inf where masks tell of none.
        pitch_m: edge of the cell within which each may lie.
    """

    poses: NDArray[np.float64]
    log_weights: NDArray[np.float64]
    pitch_m: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Initialisation:
    """The best scene found and the pools that it was chosen from.

    Attributes:
        poses: (N, 7) camera_from_box, wxyz_xyz; meaningless where not found.
        found: (N,) bool.
        rivals: (N, 7) where each object is in the best scene with it, of those not found.
        pools: (N, K, 7).
        log_gains: (N, K) log density of the scene with each pose of the pool in place of the best one,
            less that of the best scene; the last column is without the object.
        log_alone: (N, K) the same where nothing else is in the scene.
        atoms: of masks, where they were asked for.
    """

    poses: NDArray[np.float64]
    found: NDArray[np.bool_]
    rivals: NDArray[np.float64]
    pools: NDArray[np.float64]
    log_gains: NDArray[np.float64]
    log_alone: NDArray[np.float64]
    atoms: BoltzmannAtoms | None = None

    def with_scene(self, found: NDArray[np.bool_], poses: NDArray[np.float64]) -> Initialisation:
        """The same pools with another best scene: the objects `found` (N,) at poses (N, 7)."""
        return replace(self, found=found, poses=np.where(found[:, None], poses, self.poses))

    def of_slots(self, found: FoundObjects) -> Initialisation:
        """The best scene and its pools of some objects alone, in their slots."""
        return Initialisation(
            poses=found.poses(self.poses),
            found=found.present,
            rivals=self.rivals[found.placed],
            pools=self.pools[found.placed],
            log_gains=self.log_gains[found.placed],
            log_alone=self.log_alone[found.placed],
            atoms=self.atoms
            and replace(
                self.atoms,
                poses=self.atoms.poses[found.placed],
                log_weights=self.atoms.log_weights[found.placed],
            ),
        )
