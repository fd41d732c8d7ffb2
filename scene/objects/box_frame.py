"""The box about an object: faces on which it can lie, sizes that may change, one frame for all of these."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from scene.objects.orientations import cube_rotations

LESS = 0.9
"""Of the volume of the box along a mesh's own axes: a box that is less is along the object's faces, where the
mesh is turned. Meshes that stand along their axes have such boxes to 0.94 and more of their least ones."""


def box_about(vertices_m: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`box_from_object` (4, 4) and half sizes (3,) of the box about vertices (V, 3).

    It lies along the mesh's axes unless the least box is much smaller; of the 24 ways to name the axes of
    that one, the mesh's are nearest.

    Raises:
        ValueError: the vertices span no box.
    """
    try:
        hull = ConvexHull(np.asarray(vertices_m, np.float64))
    except (QhullError, ValueError) as error:
        raise ValueError("the mesh has no extent in some direction") from error
    vertices_m, turn = hull.points[hull.vertices], np.eye(3)
    least_from_object, extents_m = trimesh.bounds.oriented_bounds(vertices_m)
    if np.prod(extents_m) < LESS * np.prod(np.ptp(vertices_m, axis=0)):
        turn = max(cube_rotations() @ least_from_object[:3, :3], key=np.trace)
    turned_m = vertices_m @ turn.T
    low, high = turned_m.min(axis=0), turned_m.max(axis=0)
    box_from_object = np.eye(4)
    box_from_object[:3, :3], box_from_object[:3, 3] = turn, -(low + high) / 2
    return box_from_object, (high - low) / 2
