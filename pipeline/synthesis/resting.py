"""One object at rest on a table or another object: its stable poses, its contacts, its balance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from recordings.truth import TABLE

FLUSH_COS = np.cos(np.radians(5.0))
"""A bounding-box face within this angle of the horizontal lies flush: about two standard deviations of the
contact prior's slack at its loosest (kappa 300)."""
BALANCE_MARGIN_M = 0.003
"""How far inside its contacts a centre of mass must stay."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RestingObject:
    """An object at rest.

    Attributes:
        name: unique in its scene.
        shape: name of the mesh.
        mesh: surface in the object's frame.
        world_from_object: (4, 4) rigid transform; the world's z points up.
        carrier: the object that it rests on, None for the table.
        contacts_xy_m: (N, 2) places where it touches its supporter.
    """

    name: str
    shape: str
    mesh: trimesh.Trimesh
    world_from_object: NDArray[np.float64]
    carrier: RestingObject | None
    contacts_xy_m: NDArray[np.float64]

    @property
    def parent(self) -> str:
        """Name of the supporter."""
        return self.carrier.name if self.carrier else TABLE

    @cached_property
    def vertices_m(self) -> NDArray[np.float64]:
        """Vertices (V, 3) in the world."""
        return trimesh.transform_points(self.mesh.vertices, self.world_from_object)

    @cached_property
    def centre_of_mass_m(self) -> NDArray[np.float64]:
        """Centre of mass (3,) in the world, of uniform density."""
        return trimesh.transform_points([solid(self.mesh).center_mass], self.world_from_object)[0]

    @property
    def contact_faces(self) -> tuple[str, str] | None:
        """Bounding-box faces (supporter's, own) that lie flush on each other, if they do."""
        own = self._level_face(-1)
        theirs = "+z"
        if self.carrier:
            stands_on_top = self.vertices_m[:, 2].min() > self.carrier.vertices_m[:, 2].max() - 0.005
            theirs = self.carrier._level_face(1) if stands_on_top else None
        return (theirs, own) if own and theirs else None

    def _level_face(self, direction: int) -> str | None:
        """The bounding-box face whose outward normal points up (1) or down (-1), if one does."""
        vertical = direction * self.world_from_object[2, :3]
        axis = int(np.abs(vertical).argmax())
        if abs(vertical[axis]) < FLUSH_COS:
            return None
        return ("+" if vertical[axis] > 0 else "-") + "xyz"[axis]

    def is_above(self, other: RestingObject) -> bool:
        """True if this is `other` or rests on it, directly or through others."""
        below: RestingObject | None = self
        while below is not None and below is not other:
            below = below.carrier
        return below is other


@lru_cache(maxsize=256)
def stable_poses(mesh: trimesh.Trimesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rests on a plane: rotations (N, 3, 3) that turn the mesh onto it, and their probabilities (N,).

    From the facets of the convex hull below the centre of mass (trimesh's quasi-static model).
    """
    poses, probabilities = trimesh.poses.compute_stable_poses(solid(mesh), threshold=1e-3)
    return poses[:, :3, :3], probabilities / probabilities.sum()


def is_balanced(candidate: RestingObject, pile: Sequence[RestingObject]) -> bool:
    """True if nothing below `candidate` tips over when it is added to `pile`.

    Each object's centre of mass, together with all that it carries, must stand over its contacts.
    """
    carrier: RestingObject | None = candidate
    while carrier is not None:
        carried = [other for other in [*pile, candidate] if other.is_above(carrier)]
        masses = np.array([solid(other.mesh).volume for other in carried])
        centre = masses @ np.array([other.centre_of_mass_m for other in carried]) / masses.sum()
        if not _stands_over(centre[:2], carrier.contacts_xy_m):
            return False
        carrier = carrier.carrier
    return True


def solid(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh if its volume is defined, else its convex hull."""
    return mesh if mesh.is_volume else mesh.convex_hull


def _stands_over(centre_xy_m: NDArray[np.float64], contacts_xy_m: NDArray[np.float64]) -> bool:
    """True if a centre of mass lies above the hull of the contacts, by the margin of balance."""
    try:
        sides = ConvexHull(contacts_xy_m).equations
    except QhullError:  # contacts in a line, or fewer than three
        return False
    return bool((sides[:, :2] @ centre_xy_m + sides[:, 2] < -BALANCE_MARGIN_M).all())
