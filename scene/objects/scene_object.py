"""An object to look for: surface points, bounding box, the ways it can lie, and its distance field."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from scene.objects.box_frame import box_about
from scene.objects.surface_colour import SurfaceColour, surface_colour
from scene.objects.symmetry import spin_line, spins_freely, symmetry_lines
from scene.objects.voxel_library import voxelise
from shapes.rendering.object_library import ObjectLibrary

SURFACE_POINTS = 256
DENSE_POINTS, DENSE_AREA_M2 = 2**15, 0.1
"""By which a turned surface is laid on itself: 1.7 mm apart on a pitcher, and on what is larger."""

MOST_RESTS, SLACK_M = 12, 0.003
"""Ways in which an object can lie; corners so near to the support carry it, for surfaces are noisy."""

LIBRARY_VOXELS = 2**18
"""Enough for a pitch of 1 to 3 mm on objects that fit in a hand."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneObject:
    """One rigid object. Its own frame is the mesh's; the box frame lies in the box about it, along its faces.

    Attributes:
        name: of the object.
        points_m: (P, 3) float32 well-spread surface points in the box frame, in random order.
        normals: (P, 3) float32 outward.
        box_from_object: (4, 4).
        half_extents_m: (3,).
        rests: (R, 3) directions in the box frame that point down when the object lies still.
        spin_line: (2, 3) direction and point, in the box frame, of the line about which most of its surface
            is round; zeros where there is none.
        spins_freely: whether all of it is, so that no depth tells its spin.
        symmetry_lines, symmetry_orders: (3, 2, 3) and (3,) as `scene.objects.symmetry`, in the box frame.
        library: its distance field, in the box frame.
        draws: libraries of as likely shapes, as many for each object of a scene; none where it is certain.
        colour: of its surface; None where colours are not compared.
    """

    name: str
    points_m: NDArray[np.float32]
    normals: NDArray[np.float32]
    box_from_object: NDArray[np.float64]
    half_extents_m: NDArray[np.float64]
    rests: NDArray[np.float64]
    spin_line: NDArray[np.float64]
    spins_freely: bool
    symmetry_lines: NDArray[np.float64]
    symmetry_orders: NDArray[np.int_]
    library: ObjectLibrary
    draws: tuple[ObjectLibrary, ...] = ()
    colour: SurfaceColour | None = None

    @property
    def centre_m(self) -> NDArray[np.float64]:
        """The box's centre (3,) in the object's frame."""
        return np.asarray(np.linalg.inv(self.box_from_object)[:3, 3], np.float64)

    def coloured(
        self,
        vertices_m: NDArray[np.floating],
        faces: NDArray[np.integer],
        rgb: NDArray[np.uint8] | None,
        gamma: float,
    ) -> SceneObject:
        """The object with the colours (V, 3) of its mesh's vertices; None: one colour that nobody knows."""
        mesh = trimesh.Trimesh(
            trimesh.transform_points(vertices_m, self.box_from_object), faces, process=False
        )
        lines = self.spin_line, self.symmetry_lines, self.symmetry_orders
        return replace(self, colour=surface_colour(mesh, rgb, gamma, lines))


def scene_object(
    name: str,
    vertices_m: NDArray[np.floating],
    faces: NDArray[np.integer],
    draws: Sequence[tuple[NDArray[np.floating], NDArray[np.integer]]] = (),
) -> SceneObject:
    """The object with this triangle surface.

    Args:
        name: of the object.
        vertices_m: (V, 3).
        faces: (F, 3) vertex indices.
        draws: vertices and faces of as likely surfaces, where the shape is not certain.

    Raises:
        ValueError: the mesh has no face or no extent.
    """
    box_from_object, half = box_about(vertices_m[np.unique(faces)])
    mesh = trimesh.Trimesh(trimesh.transform_points(vertices_m, box_from_object), faces, process=False)
    sample = trimesh.sample.sample_surface(mesh, 8 * SURFACE_POINTS, seed=0)
    drawn, drawn_normals = np.asarray(sample[0]), mesh.face_normals[np.asarray(sample[1])]
    spread = _well_spread(drawn)
    points, normals = drawn[spread], drawn_normals[spread]
    lines, orders = symmetry_lines(drawn, drawn_normals)
    line = spin_line(points, normals)
    volume = float(np.prod(2 * half))
    pitch = max((volume / LIBRARY_VOXELS) ** (1 / 3), float(half.max()) / 250)
    return SceneObject(
        name=name,
        points_m=points.astype(np.float32),
        normals=normals.astype(np.float32),
        box_from_object=box_from_object,
        half_extents_m=half,
        rests=stable_rests(np.asarray(mesh.vertices, np.float64)),
        spin_line=line,
        spins_freely=bool(line.any()) and spins_freely(_dense_points(mesh), line),
        symmetry_lines=lines,
        symmetry_orders=orders,
        library=voxelise(mesh.vertices, faces, pitch),
        draws=tuple(
            voxelise(trimesh.transform_points(drawn_m, box_from_object), drawn_faces, pitch)
            for drawn_m, drawn_faces in draws
        ),
    )


def _dense_points(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Points (P, 3) of a surface in random order, as near to each other as `spins_freely` wants them."""
    count = math.ceil(DENSE_POINTS * max(mesh.area / DENSE_AREA_M2, 1.0))
    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=0)[0], np.float64)


def stable_rests(vertices_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions (R, 3) that can point down: the convex hull stands on a facet under its centre of mass.

    Facets within `SLACK_M` of the supporting plane count as one, for rounded and noisy surfaces. Rests
    are at least 20 degrees apart, the steadiest first.
    """
    hull = ConvexHull(vertices_m)
    corners = vertices_m[hull.vertices]
    centre = _hull_centroid(hull, vertices_m)
    normals = hull.equations[np.argsort(-_facet_areas(hull, vertices_m)), :3]
    rests: list[tuple[float, NDArray[np.float64]]] = []
    for down in _apart(normals, 6.0, 200):
        heights = corners @ down
        area = _support_area(corners[heights > heights.max() - SLACK_M], down, centre)
        if area > 0:
            rests.append((area / (heights.max() - centre @ down), down))
    rests.sort(key=lambda rest: -rest[0])
    chosen = _apart(np.array([down for _, down in rests]).reshape(-1, 3), 20.0, MOST_RESTS)
    return chosen if len(chosen) else np.array([[0.0, 0.0, -1.0]])


def _support_area(foot: NDArray[np.float64], down: NDArray[np.float64], centre: NDArray[np.float64]) -> float:
    """Area of the foot's outline if the centre of mass is above it, else 0."""
    across = np.linalg.svd(down[None])[2][1:]
    try:
        outline = ConvexHull(foot @ across.T)
    except (QhullError, ValueError):  # fewer than three corners, or all in a line
        return 0.0
    outside = outline.equations[:, :2] @ (across @ centre) + outline.equations[:, 2]
    return float(outline.volume) if outside.max() < 0.002 else 0.0


def _apart(directions: NDArray[np.float64], degrees: float, most: int) -> NDArray[np.float64]:
    """The first directions of a list that are further apart than an angle."""
    chosen = np.zeros((0, 3))
    for direction in directions:
        if (chosen @ direction < np.cos(np.radians(degrees))).all():
            chosen = np.concatenate([chosen, direction[None]])
        if len(chosen) >= most:
            break
    return chosen


def _hull_centroid(hull: ConvexHull, vertices_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Centre of mass of the hull: the mean of tetrahedra from an inner point."""
    inner = vertices_m[hull.vertices].mean(axis=0)
    triangles = vertices_m[hull.simplices] - inner
    volumes = np.abs(np.linalg.det(triangles))
    return inner + (volumes[:, None] * triangles.sum(axis=1) / 4).sum(axis=0) / volumes.sum()


def _facet_areas(hull: ConvexHull, vertices_m: NDArray[np.float64]) -> NDArray[np.float64]:
    a, b, c = np.moveaxis(vertices_m[hull.simplices], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def _well_spread(points: NDArray[np.float64]) -> NDArray[np.int_]:
    """Places of the farthest-point subset, shuffled so that any prefix is spread too."""
    chosen = [0]
    nearest = np.linalg.norm(points - points[0], axis=1)
    for _ in range(SURFACE_POINTS - 1):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.random.default_rng(0).permutation(chosen)
