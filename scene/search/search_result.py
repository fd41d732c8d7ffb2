"""The result of the search: the best scene, and the pools that it was chosen from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scene.objects.slots import FoundObjects
from shapes.geometry.poses import matrices_of, poses_of


@dataclass(frozen=True, kw_only=True, eq=False)
class BoltzmannAtoms:
    """Poses of N objects from masks, told by the image alone: no object's present pose decides them.

    Attributes:
        poses: (N, A, 7) camera_from_box.
        log_weights: (N, A), normalised over A; -inf where masks tell of none, or were not asked.
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
        atoms: of masks, of what was found, where they were asked for.
    """

    poses: NDArray[np.float64]
    found: NDArray[np.bool_]
    rivals: NDArray[np.float64]
    pools: NDArray[np.float64]
    log_gains: NDArray[np.float64]
    log_alone: NDArray[np.float64]
    atoms: BoltzmannAtoms | None = None

    def with_scene(
        self, found: NDArray[np.bool_], poses: NDArray[np.float64], moved: NDArray[np.bool_]
    ) -> Initialisation:
        """Another best scene: the objects `found` (N,) at poses (N, 7).

        The pools are the same but for objects that have `moved` (N,): what chains are offered of these is
        where they are now, for in the scene before it was something else that explained their place.
        """
        inside = moved[:, None] & (np.arange(self.log_gains.shape[1]) < self.pools.shape[1])
        atoms = self.atoms
        return replace(
            self,
            found=found,
            poses=np.where(found[:, None], poses, self.poses),
            pools=np.where(moved[:, None, None], poses[:, None], self.pools),
            log_gains=np.where(inside, 0.0, self.log_gains),
            atoms=atoms and replace(atoms, log_weights=np.where(moved[:, None], -np.inf, atoms.log_weights)),
        )

    def seen_from(self, other_from_camera: NDArray[np.float64]) -> Initialisation:
        """The same in another camera's frame (4, 4)."""

        def moved(poses: NDArray[np.float64]) -> NDArray[np.float64]:
            return poses_of(other_from_camera @ matrices_of(poses))

        return replace(
            self,
            poses=moved(self.poses),
            rivals=moved(self.rivals),
            pools=moved(self.pools),
            atoms=self.atoms and replace(self.atoms, poses=moved(self.atoms.poses)),
        )

    @classmethod
    def of_each(cls, starts: Sequence[Initialisation], rows: NDArray[np.integer]) -> Initialisation:
        """Every object as one of several searches (N,) has it; atoms where all have some."""
        atoms = [one.atoms for one in starts if one.atoms is not None]
        of_atoms = None
        if len(atoms) == len(starts):
            poses, log_weights = (_rows(atoms, name, rows) for name in ("poses", "log_weights"))
            of_atoms = replace(atoms[0], poses=poses, log_weights=log_weights)
        return cls(**{name: _rows(starts, name, rows) for name in _OF_OBJECTS}, atoms=of_atoms)

    def of_slots(self, found: FoundObjects) -> Initialisation:
        """The best scene and its pools of some objects alone, in their slots."""
        rows, atoms = found.placed, self.atoms
        atoms = atoms and replace(atoms, poses=atoms.poses[rows], log_weights=atoms.log_weights[rows])
        told = {name: getattr(self, name)[rows] for name in _OF_OBJECTS}
        told |= {"poses": found.poses(self.poses), "found": found.present}
        return replace(self, **told, atoms=atoms)


_OF_OBJECTS = "poses", "found", "rivals", "pools", "log_gains", "log_alone"
"""What an `Initialisation` tells of each object."""


def _rows(tables: Sequence[Initialisation | BoltzmannAtoms], name: str, rows: NDArray[np.integer]) -> NDArray:
    """Of tables' arrays (N, ...) of one name, row n of that table which `rows` (N,) names."""
    return np.stack([getattr(one, name) for one in tables])[rows, np.arange(len(rows))]
