"""What lies inside a mesh: by the parity of rays where it is closed, by winding numbers where it is not."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from pipeline.errors import PipelineError
from pipeline.synthesis.world import Part, RayCaster

HALF = 0.5
"""Winding number between that of points inside, 1, and outside, 0, of a closed surface."""
PAIRS = 2**21
"""Of points and triangles at a time."""


def lies_inside(mesh: trimesh.Trimesh, points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether points (N, 3) lie inside a mesh, which may have holes.

    Raises:
        PipelineError: it has holes, and faces wound both ways: nothing says what is inside.
    """
    if mesh.is_watertight:
        return RayCaster([Part(name="mesh", mesh=mesh, world_from_part=np.eye(4))]).holds(points)
    if not mesh.is_winding_consistent:
        raise PipelineError("a true mesh has holes and faces wound both ways: repair it to compare with it")
    low, high = mesh.bounds
    near = np.all((points >= low) & (points <= high), axis=1)
    inside = np.zeros(len(points), np.bool_)
    inside[near] = np.abs(winding_numbers(mesh.triangles, points[near])) > HALF
    return inside


def winding_numbers(triangles: NDArray[np.floating], points: NDArray[np.floating]) -> NDArray[np.float64]:
    """How often triangles (F, 3, 3) wind round points (N, 3): signed solid angles over 4 pi.

    Jacobson et al. 2013; the solid angle by Van Oosterom and Strackee 1983. Over a hole it changes smoothly.
    """
    numbers = np.empty(len(points))
    chunk = max(PAIRS // max(len(triangles), 1), 1)
    for start in range(0, len(points), chunk):
        corner = triangles.transpose(1, 0, 2)[:, None] - points[None, start : start + chunk, None]
        a, b, c = corner
        length = np.linalg.norm(corner, axis=-1)
        volume = (a * np.cross(b, c)).sum(axis=-1)
        dots = [(one * other).sum(axis=-1) for one, other in ((b, c), (c, a), (a, b))]
        solid = length.prod(axis=0) + sum(dot * size for dot, size in zip(dots, length, strict=True))
        numbers[start : start + chunk] = np.arctan2(volume, solid).sum(axis=1) / (2 * np.pi)
    return numbers
