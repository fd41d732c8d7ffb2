"""What really stood in front of the camera of a synthesised recording; only `eval` and benches read it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TABLE = "table"
"""Name of the support plane wherever a parent or an edge is named."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueObject:
    """One object of a scene, with its surface.

    Attributes:
        name: unique in its scene.
        shape: name of the mesh; instances of one mesh share it.
        world_from_object: (4, 4) float64 rigid transform.
        vertices_m: (V, 3) float64 in the object's frame.
        faces: (F, 3) int32 rows of `vertices_m`, counter-clockwise from outside.
        parent: name of what the object rests on: another object, `TABLE`, or None where it floats.
        contact_faces: the parent's and the object's own bounding-box face that lie flush, such as
            ("+z", "-x"), "+z" for the table; None where the rest is not flush.
        visible_fraction: share of the object's pixels that the first frame shows, counted in an image
            large enough to hold the whole object.
    """

    name: str
    shape: str
    world_from_object: NDArray[np.float64]
    vertices_m: NDArray[np.float64]
    faces: NDArray[np.int32]
    parent: str | None
    contact_faces: tuple[str, str] | None
    visible_fraction: float


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneTruth:
    """The objects of a recording in its world frame, the parent frame of the camera truth in /tf.

    Attributes:
        objects: every object of interest; furniture and clutter are left out.
        support_plane: (4,) unit normal and offset, n . x + d = 0 in the world frame with the normal up,
            or None where nothing supports an object.
    """

    objects: tuple[TrueObject, ...]
    support_plane: NDArray[np.float64] | None
