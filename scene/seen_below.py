"""What the image shows below a pose that hangs in the air: nothing, or a thing that may carry it.

Nobody may have asked for that thing, or the search not have found it yet.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN
from scene.detection import SupportPlane
from scene.observation import DepthView, unprojected

UNDERSIDE_M, UNDERSIDE_POINTS = 0.01, 12
"""Surface points so far over the lowest one are an object's underside; so many of them are looked below."""
STEP_M, STEPS = 0.008, 10
"""Between the places below each of them, the first half a step below."""
BEHIND_M = 0.01
"""What is seen so far behind a place leaves it empty."""


def undersides(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (K, UNDERSIDE_POINTS, 3) of the underside of K poses, the lowest first; it fills up the rest.

    Args:
        points_m: (K, P, 3) surface points in random order; the third axis points up.
    """
    over_m = points_m[..., 2] - points_m[..., 2].min(axis=1, keepdims=True)
    rank = np.where(over_m > 0, np.where(over_m < UNDERSIDE_M, 1, 2), 0)
    first = np.argsort(rank, axis=1, kind="stable")[:, :UNDERSIDE_POINTS]
    low = np.take_along_axis(rank, first, axis=1) < 2
    return np.take_along_axis(points_m, np.where(low, first, first[:, :1])[..., None], axis=1)


def gaps_to_seen(
    view: DepthView, table: SupportPlane, undersides_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Gaps (K,) from the lowest points to the top of the things that are seen where something may carry them.

    +inf where more of what is below is seen to be empty than is hidden by things less high. Those as high
    as the pose may be the object itself, and tell nothing.

    Args:
        view: of the table.
        table: in the camera's frame.
        undersides_m: (K, C, 3) in the table's frame, the lowest point first.
    """
    depth_m, foreground = np.asarray(view.depth_m), np.asarray(view.unexplained)
    heights_m = table.in_table_frame(unprojected(depth_m, view.camera))[..., 2]
    down_m = STEP_M * (np.arange(STEPS) + 0.5)
    below_m = undersides_m[:, :, None] - down_m[:, None] * np.array([0.0, 0.0, 1.0])
    in_camera = below_m @ table.camera_from_table[:3, :3].T + table.camera_from_table[:3, 3]
    rows, columns, inside = view.pixels(in_camera)
    seen_m, gaps_m = depth_m[rows, columns], undersides_m[:, :1, None, 2] - heights_m[rows, columns]
    told = inside & (below_m[..., 2] > 0) & (seen_m != NO_RETURN)
    empty = told & (seen_m > in_camera[..., 2] + BEHIND_M)
    carries = told & ~empty & foreground[rows, columns] & (gaps_m > 0)
    top_m = np.where(carries, gaps_m, np.inf).min(axis=(1, 2))
    return np.where(carries.sum(axis=(1, 2)) > empty.sum(axis=(1, 2)), top_m, np.inf)
