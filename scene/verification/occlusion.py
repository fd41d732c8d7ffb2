"""Where an object can stand without being seen: behind others, or where nothing was measured.

An object that no pixel shows is there with its prior probability if the camera cannot see where it might
stand, and is not if it can. Of the poses that it has a priori on the table this is the share that changes
none of the images; a pose that shows anything is left to the search.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recordings.types import NO_RETURN
from scene.objects.orientations import resting_rotations
from scene.objects.scene_object import SceneObject
from scene.observation.depth_view import PooledView
from scene.observation.detection import SupportPlane

DRAWS, POINTS = 512, 128

NEARER_M = 0.005
"""A surface point is hidden where what was measured is nearer by this."""

SHOWN = 0.02
"""Share of the points that face the camera that may be seen of what counts as hidden: points are coarse."""

TOUCHING_M = 0.003
"""Depth to which boxes may enter each other."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedObject:
    """An object that was found.

    Attributes:
        shape: the object.
        table_from_box: (4, 4).
    """

    shape: SceneObject
    table_from_box: NDArray[np.float64]


def unseen_share(
    rng: np.random.Generator,
    views: Sequence[tuple[PooledView, SupportPlane]],
    one: SceneObject,
    others: Sequence[PlacedObject],
) -> float:
    """Share of an object's poses on the table, in sight of a camera and clear of others, that no view shows.

    Args:
        rng: random numbers.
        views: images, each with the table in its camera's frame.
        one: the object.
        others: those that were found.
    """
    rotations, offsets = _resting_poses(rng, one, views[0][1].half_size_m)
    points = one.points_m[:POINTS] @ np.swapaxes(rotations, 1, 2) + offsets[:, None]
    normals = one.normals[:POINTS] @ np.swapaxes(rotations, 1, 2)
    in_sight, shown = np.zeros(DRAWS, bool), np.zeros(DRAWS, bool)
    for view, table in views:
        seen_here = _share_seen(view, table.camera_from_table, points, normals)
        in_sight |= _in_image(view, table.camera_from_table, offsets)
        shown |= seen_here > SHOWN
    possible = in_sight & ~_meets(rotations, offsets, points, one, others)
    return float((possible & ~shown).sum() / max(possible.sum(), 1))


def _resting_poses(
    rng: np.random.Generator, one: SceneObject, half_size_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations (D, 3, 3) and offsets (D, 3) of the box in the table's frame, lying still anywhere on it."""
    upright = resting_rotations(one.rests, 1)[rng.integers(len(one.rests), size=DRAWS)]
    yaws = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (DRAWS, 1))).as_matrix()
    rotations = yaws @ upright
    heights = -np.einsum("dj,pj->dp", rotations[:, 2], one.points_m).min(axis=1)
    return rotations, np.column_stack([rng.uniform(-half_size_m, half_size_m, (DRAWS, 2)), heights])


def _share_seen(
    view: PooledView,
    camera_from_table: NDArray[np.float64],
    points_m: NDArray[np.float64],
    normals: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Of the points (D, P, 3) that face the camera the share (D,) that nothing measured hides."""
    turn = camera_from_table[:3, :3].T
    placed = points_m @ turn + camera_from_table[:3, 3]
    facing = ((normals @ turn) * placed).sum(axis=-1) < 0
    rows, columns, inside = view.pixels(placed)
    observed_m = np.asarray(view.depth_m)[rows, columns]
    seen = inside & (observed_m != NO_RETURN) & (observed_m > placed[..., 2] - NEARER_M)
    return (seen & facing).sum(axis=1) / np.maximum(facing.sum(axis=1), 1)


def _in_image(
    view: PooledView, camera_from_table: NDArray[np.float64], points_m: NDArray[np.float64]
) -> NDArray[np.bool_]:
    return view.pixels(points_m @ camera_from_table[:3, :3].T + camera_from_table[:3, 3])[2]


def _meets(
    rotations: NDArray[np.float64],
    offsets: NDArray[np.float64],
    points_m: NDArray[np.float64],
    one: SceneObject,
    others: Sequence[PlacedObject],
) -> NDArray[np.bool_]:
    """Whether the object in each of D poses is where another is: surface points in each other's boxes."""
    meets = np.zeros(len(rotations), bool)
    for other in others:
        turn, offset = other.table_from_box[:3, :3], other.table_from_box[:3, 3]
        meets |= _any_inside((points_m - offset) @ turn, other.shape.half_extents_m)
        theirs = other.shape.points_m[:POINTS] @ turn.T + offset
        meets |= _any_inside((theirs - offsets[:, None]) @ rotations, one.half_extents_m)
    return meets


def _any_inside(points_m: NDArray[np.float64], half_extents_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    inside = np.abs(points_m) < half_extents_m - TOUCHING_M
    return np.asarray(inside.all(axis=-1).any(axis=-1))
