"""Depth images at the search's resolution."""

import numpy as np
import pytest

from recordings.types import CameraIntrinsics
from scene.observation.depth_view import pooled_view, unproject


@pytest.mark.parametrize(("width", "height"), [(640, 480), (848, 480), (1024, 1024), (317, 203)])
def test_pooled_pixels_lie_on_the_rays_of_their_blocks(width: int, height: int) -> None:
    """A wall at 1 m, also where blocks do not divide the image: the last columns and rows are left out."""
    intrinsics = CameraIntrinsics(
        width=width, height=height, fx=600.0, fy=590.0, cx=0.45 * width, cy=0.55 * height
    )
    wall = np.ones((height, width), np.float32)

    view = pooled_view(wall, intrinsics, 160)

    factor = round(width / 160)
    rows, columns = height // factor, width // factor
    of_pixels = unproject(wall, intrinsics)[: rows * factor, : columns * factor]
    of_blocks = of_pixels.reshape(rows, factor, columns, factor, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(unproject(np.asarray(view.depth_m), view.camera), of_blocks, atol=1e-6)
