"""What the frames of a scene have measured before each of them: depths foretold from one frame to another.

Frames are given in an order, and each has the density of its image given those before it. All frames see the
same surfaces, and what a mesh, a pose or a support errs by they share: taken for independent frames would count
these errors once each. Depths that earlier frames measured, seen from where the camera is now, foretell its
image but for the sensor's noise and the error of the motion between (docs/model.md, section L2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recordings.types import NO_RETURN
from scene.likelihood.unknown_surfaces import JOINED_M
from scene.observation.depth_view import project, unproject
from scene.observation.frame_data import SceneData
from shapes.geometry.poses import transform_points

NEAR_PX = 0.75, 1.5
"""Pixels of the image about a compared one whose points foretell it: half the way to the next compared one
within these; the first finds one where frames are as near as each other, the second averages noise."""


def earlier_depths(
    views: Sequence[SceneData], camera_from_world: NDArray[np.float64], order: Sequence[int]
) -> list[NDArray[np.float32]]:
    """Depth (H, W) at the compared pixels of each view that frames before it in `order` have measured.

    `NO_RETURN` where none has; of several the last.

    Args:
        views: F frames.
        camera_from_world: (F, 4, 4).
        order: of the F frames.
    """
    told_m = [np.full_like(view.window.depth_m, NO_RETURN) for view in views]
    for place, frame in enumerate(order):
        for earlier in order[:place]:
            camera_from_earlier = camera_from_world[frame] @ np.linalg.inv(camera_from_world[earlier])
            seen_m = _seen_from(views[frame], views[earlier], camera_from_earlier)
            told_m[frame] = np.where(seen_m == NO_RETURN, told_m[frame], seen_m)
    return told_m


def _seen_from(
    view: SceneData, other: SceneData, camera_from_other: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Depth (H, W) at the compared pixels of a view of what another has measured, `NO_RETURN` where nothing.

    Of the points about a pixel those of the nearest surface count, by their mean.
    """
    window, measured = view.window, other.depth_m != NO_RETURN
    points_m = transform_points(camera_from_other, unproject(other.depth_m, other.intrinsics)[measured])
    row, column, ahead = project(points_m, window.camera)
    rows, columns = np.rint(row), np.rint(column)
    near = np.clip(0.5 * window.stride, *NEAR_PX) / window.stride
    height, width = window.depth_m.shape
    use = ahead & (np.abs(row - rows) <= near) & (np.abs(column - columns) <= near)
    use &= (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    pixels, depth_m = (rows * width + columns)[use].astype(np.intp), points_m[use, 2]
    first_m = np.full(height * width, np.inf)
    np.minimum.at(first_m, pixels, depth_m)
    joined = depth_m < first_m[pixels] + JOINED_M
    count = np.bincount(pixels[joined], minlength=height * width)
    total_m = np.bincount(pixels[joined], depth_m[joined], minlength=height * width)
    seen_m = np.where(count > 0, total_m / np.maximum(count, 1), NO_RETURN)
    return seen_m.reshape(height, width).astype(np.float32)
