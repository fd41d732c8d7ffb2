"""Objects let down on a table and on one another, without overlap.

An object sinks vertically in one of its stable poses until it meets what stands below. It stays there if
one supporter alone holds it, on a surface that is nearly level, and if nothing in the pile loses balance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipeline.errors import PipelineError
from pipeline.synthesis.resting import RestingObject, is_balanced, stable_poses
from pipeline.synthesis.world import NOTHING, Part, RayCaster

CELL_M = 0.002
"""Spacing of the vertical rays by which an object is let down."""
CONTACT_M = 0.001
"""Cells whose gap is smaller touch."""
LEVEL_COS = np.cos(np.radians(6.0))
"""A surface is level where its normal's vertical part is larger."""
LEVEL_SHARE = 0.6
"""Share of the touching cells that must be level: more than a lying mug offers."""
PLACES = 40
"""Places tried for one object before the arrangement is given up."""
ARRANGEMENTS = 6
"""Arrangements begun before the objects are refused."""

DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class Table:
    """A level support round the origin.

    Attributes:
        height_m: height of its top.
        radius_m: nothing reaches farther from the origin.
        spread_m: standard deviation of the places on it.
    """

    height_m: float
    radius_m: float
    spread_m: float


def rest_on_table(
    shapes: Sequence[tuple[str, trimesh.Trimesh]],
    table: Table,
    rng: np.random.Generator,
    *,
    stacked_share: float = 0.0,
) -> list[RestingObject]:
    """Stand named meshes on a table, at least `stacked_share` of them on one another.

    Raises:
        PipelineError: the objects do not fit, or cannot be stacked so often.
    """
    refused = ""
    for _ in range(ARRANGEMENTS):
        pile = _Pile(table)
        refused = _arrange(pile, shapes, rng, stacked_share)
        if not refused:
            return pile.objects
    raise PipelineError(f"no room for {refused}: take fewer or other objects, or a larger spread")


def _arrange(
    pile: _Pile, shapes: Sequence[tuple[str, trimesh.Trimesh]], rng: np.random.Generator, stacked_share: float
) -> str:
    """Fill `pile`, large shapes first so that they can carry; the object that found no place, or nothing."""
    sizes = [np.prod(mesh.extents) * rng.uniform(0.5, 1.0) for _, mesh in shapes]
    stacked = int(np.ceil(stacked_share * len(shapes)))
    for position, index in enumerate(np.argsort(sizes)[::-1]):
        on_object = len(shapes) - position <= stacked
        shape, mesh = shapes[index]
        for _ in range(PLACES):
            if pile.let_down(_instance_name(shapes, index), shape, mesh, rng, on_object=on_object):
                break
        else:
            return f"{_instance_name(shapes, index)} on {'another object' if on_object else 'the table'}"
    return ""


class _Pile:
    """The table and everything that rests on it so far."""

    def __init__(self, table: Table) -> None:
        self.objects: list[RestingObject] = []
        self._table = table
        self._caster = RayCaster([])

    def let_down(
        self, name: str, shape: str, mesh: trimesh.Trimesh, rng: np.random.Generator, *, on_object: bool
    ) -> bool:
        """Lower a mesh in a random rest at a random place; True if it stays there as asked."""
        rotations, probabilities = stable_poses(mesh)
        pose = np.eye(4)
        yaw = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)]).as_matrix()
        pose[:3, :3] = yaw @ rotations[rng.choice(len(rotations), p=probabilities)]
        place = self._level_place(rng) if on_object else rng.normal(scale=self._table.spread_m, size=2)
        if place is None:
            return False
        pose[:2, 3] = place - (pose[:3, :3] @ mesh.center_mass)[:2]
        vertices = trimesh.transform_points(mesh.vertices, pose)
        if np.linalg.norm(vertices[:, :2], axis=1).max() > self._table.radius_m:
            return False
        settle = self._settle_on_object if on_object else self._settle_on_table
        resting = settle(name, shape, mesh, pose)
        if resting is None:
            return False
        self.objects.append(resting)
        self._caster = RayCaster([_part(resting.mesh, resting.world_from_object) for resting in self.objects])
        return True

    def _settle_on_table(
        self, name: str, shape: str, mesh: trimesh.Trimesh, pose: NDArray[np.float64]
    ) -> RestingObject | None:
        lowest = trimesh.transform_points(mesh.vertices, pose)
        pose[2, 3] = self._table.height_m - lowest[:, 2].min()
        cells, underside = _underside(mesh, pose)
        if self.objects and (underside < self._heights(cells)[0] - 1e-4).any():
            return None
        contacts = lowest[lowest[:, 2] < lowest[:, 2].min() + CONTACT_M, :2]
        return RestingObject(
            name=name, shape=shape, mesh=mesh, world_from_object=pose, carrier=None, contacts_xy_m=contacts
        )

    def _settle_on_object(
        self, name: str, shape: str, mesh: trimesh.Trimesh, pose: NDArray[np.float64]
    ) -> RestingObject | None:
        cells, underside = _underside(mesh, pose)
        height, normal, owner = self._heights(cells)
        gap = underside - height
        touching = gap < gap.min() + CONTACT_M
        owners = np.unique(owner[touching])
        if (
            len(owners) > 1
            or owners[0] == NOTHING
            or (np.abs(normal[touching, 2]) > LEVEL_COS).mean() < LEVEL_SHARE
        ):
            return None
        pose[2, 3] = -gap.min()
        resting = RestingObject(
            name=name,
            shape=shape,
            mesh=mesh,
            world_from_object=pose,
            carrier=self.objects[owners[0]],
            contacts_xy_m=cells[touching],
        )
        return resting if is_balanced(resting, self.objects) else None

    def _heights(self, cells_xy_m: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
        """Top of what stands at cells (N, 2): height (N,), normal (N, 3), object's index or `NOTHING`."""
        ceiling = self._table.height_m + 3.0
        hits = self._caster.cast(np.insert(cells_xy_m, 2, ceiling, axis=1), DOWN)
        height = np.where(
            hits.part == NOTHING, self._table.height_m, ceiling - hits.distance.astype(np.float64)
        )
        return height, hits.normal, hits.part

    def _level_place(self, rng: np.random.Generator) -> NDArray[np.float64] | None:
        """A place (2,) on a level part of a random object that rests already."""
        corners = self.objects[rng.integers(len(self.objects))].vertices_m
        places = rng.uniform(corners[:, :2].min(axis=0), corners[:, :2].max(axis=0), size=(256, 2))
        _, normal, owner = self._heights(places)
        level = places[(owner != NOTHING) & (np.abs(normal[:, 2]) > LEVEL_COS)]
        return level.mean(axis=0) + rng.normal(scale=0.4 * level.std(axis=0)) if len(level) > 20 else None


def _underside(mesh: trimesh.Trimesh, pose: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """Cells (N, 2) below a posed mesh and the height (N,) of its lowest surface above each."""
    vertices = trimesh.transform_points(mesh.vertices, pose)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    axes = [np.arange(low[axis] + CELL_M / 2, high[axis], CELL_M) for axis in (0, 1)]
    cells = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    floor = low[2] - 0.01
    distance = RayCaster([_part(mesh, pose)]).cast(np.insert(cells, 2, floor, axis=1), -DOWN).distance
    met = np.isfinite(distance)
    return cells[met], floor + distance[met].astype(np.float64)


def _part(mesh: trimesh.Trimesh, pose: NDArray[np.float64]) -> Part:
    return Part(name="", mesh=mesh, world_from_part=pose)


def _instance_name(shapes: Sequence[tuple[str, trimesh.Trimesh]], index: int) -> str:
    """The shape's name, numbered from its second instance on."""
    shape = shapes[index][0]
    earlier = sum(name == shape for name, _ in shapes[:index])
    return shape if earlier == 0 else f"{shape} {earlier + 1}"
