"""What one colour camera looks at: kinds of things, the square of a table, a lamp.

World frame: the table's top is z = 0, z up. A thing stands upright on it; its pose is (x, y, yaw).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree

from recordings.settings import check_finite, check_within
from recordings.types import CameraIntrinsics
from scene.colour.density import ColourNoise
from scene.objects.symmetry import spin_line
from shapes.rendering.meshes import Mesh, MeshSet
from shapes.rendering.smooth_normals import normal_fields, smooth_normals

SURFACE_POINTS = 4000
"""Points by which a surface is compared with itself turned."""
SAME_SPACINGS = 5.0
"""Median distances between neighbours that the furthest point of a turned surface may lie from the surface:
of points drawn at random on one surface twice, none in 10^4 lies further."""
SAME_COLOURS = 0.02
"""Mean difference of light from a surface's to that of the turned one: less than a pixel's noise, and a
whole thing has hundreds of pixels."""
UPRIGHT = 0.999
"""Least cosine to the vertical of a line of symmetry that stands upright: within 2.6 degrees."""
TOUCHES_M = 0.002
"""Over its lowest point what is seen as touching the table: decimated meshes are bent by as much."""
FALLS_M = 0.005
"""A middle that lies further beside the base is no error of the mesh."""
DIRECTIONS = 64
"""In which a base is looked at."""
ODD_TURNS_RAD = (0.7, 1.9, 2.6)
"""Turns that only a round thing bears, being no fractions of a full one."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """A far lamp and light from everywhere: shade = ambient + (1 - ambient) max(0, normal . direction).

    Attributes:
        direction: towards the lamp, in the world.
        ambient: share of the light that comes from everywhere.
    """

    direction: tuple[float, float, float] = (-0.4, -0.5, 0.77)
    ambient: float = 0.4

    def __post_init__(self) -> None:
        check_finite(self)
        check_within(self, 0.0, 1.0, ("ambient",))

    def shade(self, normals: NDArray[np.floating]) -> NDArray[np.float64]:
        """Shades (...) of unit normals (..., 3)."""
        return self.ambient + (1 - self.ambient) * np.maximum(normals @ self._unit, 0.0)

    def turned_shade(self, normals: NDArray[np.floating]) -> NDArray[np.float64]:
        """Rates (...) at which shades change as normals (..., 3) turn about z, per radian."""
        turning = normals[..., 0] * self._unit[1] - normals[..., 1] * self._unit[0]
        return (1 - self.ambient) * turning * (normals @ self._unit > 0)

    @cached_property
    def _unit(self) -> NDArray[np.float64]:
        return np.array(self.direction) / np.linalg.norm(self.direction)


@dataclass(frozen=True, kw_only=True, eq=False)
class Kind:
    """A shape as it stands: its base on z = 0, and over the origin the line about which it is round.

    A mug turned about that line moves its handle alone, so that place and yaw are told apart. Where a shape
    is not round it is the middle of the box.

    Attributes:
        name: of the shape.
        vertices_m: (V, 3).
        faces: (F, 3), counter-clockwise from outside.
        turns: by how many turns about z it looks the same; 0 for a round thing, whose yaw says nothing.
        base_m: (3,) where the origin is in the frame of the mesh.
        colours: (F, 3) light of 0..1 that each triangle returns; None where its one colour is unknown.
    """

    name: str
    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int64]
    turns: int
    base_m: NDArray[np.float64]
    colours: NDArray[np.float64] | None = None

    @classmethod
    def standing(cls, name: str, mesh: trimesh.Trimesh, colours: NDArray[np.floating] | None = None) -> Kind:
        """A mesh as it stands with its own z up, and the light (F, 3) that its triangles return.

        Raises:
            ValueError: it would fall over.
        """
        if (off_m := _overhang(mesh)) > FALLS_M:
            raise ValueError(
                f"{name} would not stand with its own z up: its middle is {100 * off_m:.1f} cm beside "
                "what touches the table; turn the mesh as it stands"
            )
        base = np.array([*_axis(mesh), mesh.bounds[0, 2]])
        moved = trimesh.Trimesh(mesh.vertices - base, mesh.faces, process=False)
        faces = np.asarray(mesh.faces, np.int64)
        return cls(
            name=name,
            vertices_m=np.asarray(moved.vertices),
            faces=faces,
            turns=_turns(moved, colours),
            base_m=base,
            colours=None if colours is None else np.asarray(colours, np.float64),
        )

    @cached_property
    def half_m(self) -> NDArray[np.float64]:
        """Half the width and depth (2,) of its box."""
        return np.ptp(self.vertices_m[:, :2], axis=0) / 2

    @cached_property
    def middle_m(self) -> NDArray[np.float64]:
        """Middle (2,) of its box."""
        return (self.vertices_m[:, :2].min(axis=0) + self.vertices_m[:, :2].max(axis=0)) / 2

    @cached_property
    def mesh(self) -> Mesh:
        """Its triangles."""
        return Mesh(self.vertices_m, self.faces)

    @cached_property
    def corner_normals(self) -> NDArray[np.float64]:
        """Unit normals (F, 3, 3) at the triangles' corners, rounded over edges that are no creases."""
        return smooth_normals(self.mesh)


@dataclass(frozen=True, kw_only=True, eq=False)
class TableWorld:
    """The prior of scenes and the camera.

    Attributes:
        camera: of the images.
        camera_from_world: (4, 4) rigid.
        kinds: equally probable, each thing's independent of the others'.
        half_m: things stand uniformly on the square of twice this side round the world's origin.
        most: their number is uniform on 0..most.
        light: known.
        noise: of the colours.
    """

    camera: CameraIntrinsics
    camera_from_world: NDArray[np.float64]
    kinds: tuple[Kind, ...]
    half_m: float = 0.14
    most: int = 3
    light: Light = field(default_factory=Light)
    noise: ColourNoise = field(default_factory=ColourNoise)

    def __post_init__(self) -> None:
        if not self.kinds:
            raise ValueError("a world needs at least one kind of thing")
        if self.most < 1 or self.half_m <= 0:
            raise ValueError(f"most and half_m must be positive, got {self.most} and {self.half_m}")

    @cached_property
    def is_coloured(self) -> NDArray[np.bool_]:
        """(K,) whether colours are known, of each kind."""
        return np.array([kind.colours is not None for kind in self.kinds])

    @cached_property
    def meshes(self) -> MeshSet:
        """Of all kinds."""
        return MeshSet.of([kind.mesh for kind in self.kinds])

    @cached_property
    def reaches_m(self) -> NDArray[np.float64]:
        """(K,) how far each kind's box reaches from its origin."""
        return np.array([float(np.linalg.norm(np.abs(one.middle_m) + one.half_m)) for one in self.kinds])

    @cached_property
    def turns(self) -> NDArray[np.int64]:
        """(K,) by how many turns each kind looks the same."""
        return np.array([kind.turns for kind in self.kinds])

    @cached_property
    def spins(self) -> NDArray[np.bool_]:
        """(K,) whether the yaw says nothing, of each kind."""
        return self.turns == 0

    @cached_property
    def face_tints(self) -> NDArray[np.float64]:
        """Light (F, 3) that all kinds' triangles return, 1 where unknown; (F, 1) if it is of all."""
        if not self.is_coloured.any():
            return np.ones((sum(len(kind.faces) for kind in self.kinds), 1))
        colours = [np.ones((len(one.faces), 3)) if one.colours is None else one.colours for one in self.kinds]
        return np.concatenate(colours)

    @cached_property
    def face_normals(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Normals `level + slope @ x`, (F, 3) and (F, 3, 3), at points x of all kinds' triangles in turn."""
        every = [normal_fields(kind.mesh, kind.corner_normals) for kind in self.kinds]
        return np.concatenate([level for level, _ in every]), np.concatenate([slope for _, slope in every])

    @cached_property
    def first_faces(self) -> NDArray[np.int64]:
        """Number (K,) of each kind's first triangle, counted through all kinds."""
        return np.cumsum([0, *(len(kind.faces) for kind in self.kinds)])[:-1]


def _axis(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Where (2,) the upright line stands about which most of a surface is round; else the box's middle."""
    drawn = trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=0)
    direction, point = spin_line(np.asarray(drawn[0]), mesh.face_normals[drawn[1]])
    if abs(direction[2]) < UPRIGHT:
        return mesh.bounds[:, :2].mean(axis=0)
    return (point - direction * (point[2] / direction[2]))[:2]


def _overhang(mesh: trimesh.Trimesh) -> float:
    """How far the middle of a mesh's volume lies beside the hull of its lowest points, in metres."""
    low = mesh.vertices[mesh.vertices[:, 2] < mesh.bounds[0, 2] + TOUCHES_M][:, :2]
    middle = np.asarray(mesh.convex_hull.center_mass)[:2]
    turns = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    outwards = np.column_stack([np.cos(turns), np.sin(turns)])
    return float((outwards @ middle - (outwards @ low.T).max(axis=1)).max())


def _turns(mesh: trimesh.Trimesh, colours: NDArray[np.floating] | None) -> int:
    """By how many turns about z a surface looks the same: 0 where by any, else 4, 2 or 1."""
    (points, mine), (again, other) = (
        map(np.asarray, trimesh.sample.sample_surface(mesh, SURFACE_POINTS, seed=seed)[:2]) for seed in (0, 1)
    )
    tree = KDTree(points)
    limit = SAME_SPACINGS * float(np.median(tree.query(again)[0]))

    def same(turn: float) -> bool:
        cosine, sine = np.cos(turn), np.sin(turn)
        turned = again @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
        apart_m, near = tree.query(turned)
        if apart_m.max() > limit:
            return False
        return colours is None or np.abs(colours[mine[near]] - colours[other]).mean() < SAME_COLOURS

    if all(same(turn) for turn in ODD_TURNS_RAD):
        return 0
    return next((turns for turns in (4, 2) if same(2 * np.pi / turns)), 1)
