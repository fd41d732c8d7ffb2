"""Nothing is inside the table: what no camera sees of an object below its top has a prior all the same."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scene.detection import SupportPlane
from scene.scene_object import SceneObject
from shapes.poses import matrices_of


def log_not_buried(
    table: SupportPlane | None,
    objects: Sequence[SceneObject],
    poses: NDArray[np.floating],
    sigma_m: float,
) -> NDArray[np.float64]:
    """Log prior (N, K) of how deep poses (N, K, 7) camera_from_box reach below the table, half a Gaussian.

    Of a pose that reaches not below it is 0, as it is without a table. What hangs down beside it is not
    below it.

    Args:
        table: in the camera's frame.
        objects: N.
        poses: of each of them.
        sigma_m: by which a table and poses may be wrong.
    """
    if table is None:
        return np.zeros(poses.shape[:2])
    camera_from_box = matrices_of(poses)
    deepest_m = np.empty(poses.shape[:2])
    for number, one in enumerate(objects):
        turn, offset = camera_from_box[number, :, :3, :3], camera_from_box[number, :, None, :3, 3]
        points = one.points_m.astype(np.float64) @ np.swapaxes(turn, 1, 2) + offset
        beside = np.abs(table.in_table_frame(points)[..., :2]) - table.half_size_m
        below_m = np.where((beside < 0).all(axis=-1), -table.heights(points), 0.0)
        deepest_m[number] = below_m.max(axis=1).clip(0)
    return -0.5 * (deepest_m / sigma_m) ** 2
