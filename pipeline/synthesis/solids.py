"""Solids from which objects and furniture are made; boolean operations keep them watertight."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold, OpType

SEGMENTS = 64
"""Sides of a full circle."""


def block(width: float, depth: float, height: float, x: float = 0, y: float = 0, z: float = 0) -> Manifold:
    """Box of the given size centred on (x, y), standing on z."""
    return Manifold.cube((width, depth, height)).translate((x - width / 2, y - depth / 2, z))


def cylinder(height: float, radius: float, top_radius: float = -1.0) -> Manifold:
    """Upright cylinder or cone standing on the origin."""
    return Manifold.cylinder(height, radius, top_radius, SEGMENTS)


def turned(profile: Sequence[tuple[float, float]]) -> Manifold:
    """Solid of revolution about z of a closed profile of (radius, height) corners, counter-clockwise."""
    return polygon(profile).revolve(SEGMENTS)


def polygon(corners: Sequence[tuple[float, float]]) -> CrossSection:
    """Plane figure with the given corners, counter-clockwise."""
    return CrossSection([np.array(corners, np.float64)])


def union(*solids: Manifold) -> Manifold:
    """One solid of all of them."""
    return Manifold.batch_boolean(list(solids), OpType.Add)


def surface_of(solid: Manifold) -> trimesh.Trimesh:
    """The solid's triangles in its own coordinates."""
    surface = solid.to_mesh64()
    return trimesh.Trimesh(np.asarray(surface.vert_properties)[:, :3], surface.tri_verts, process=False)
