"""The camera over the table, the square that it sees, and pooled images."""

import numpy as np
import pytest

from recordings.types import CameraIntrinsics
from scene.colour.camera_view import (
    camera_over_plane,
    camera_over_table,
    pooled_image,
    square_in_view,
)

CAMERA = CameraIntrinsics(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)


@pytest.mark.parametrize(("height_m", "pitch", "roll"), [(0.5, 40.0, 0.0), (1.2, 80.0, 35.0)])
def test_the_optical_axis_meets_the_table_at_the_origin(height_m: float, pitch: float, roll: float) -> None:
    """The camera stands at its height; turned clockwise, what lies to its right is higher in the image."""
    pose = camera_over_table(height_m, *np.radians([pitch, roll]))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose[:2, 3], 0, atol=1e-12)
    assert np.linalg.inv(pose)[2, 3] == pytest.approx(height_m)
    right = pose[:3, :3] @ [1, 0, 0]
    assert np.degrees(np.arctan2(-right[1], right[0])) == pytest.approx(roll)


def test_any_frame_of_the_table_gives_the_same_view() -> None:
    """Shifted and turned in the table's plane."""
    pose = camera_over_table(0.6, 0.9)
    plane_from_world = np.eye(4)
    plane_from_world[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    plane_from_world[:2, 3] = [0.3, -1.0]
    found = camera_over_plane(pose @ np.linalg.inv(plane_from_world))
    np.testing.assert_allclose(found[:3, 3], pose[:3, 3], atol=1e-12)
    np.testing.assert_allclose(found[:3, 2], pose[:3, 2], atol=1e-12)


@pytest.mark.parametrize("pitch", [-0.2, 0.0, 2.0])
def test_a_camera_that_does_not_look_down_is_refused(pitch: float) -> None:
    """With what it was told."""
    with pytest.raises(ValueError, match="pitch"):
        camera_over_table(0.5, pitch)


def test_the_square_touches_the_border_of_the_image() -> None:
    """Seen from straight above: half the image's height at the table's distance."""
    half = square_in_view(CAMERA, camera_over_table(0.5, np.pi / 2))
    assert half == pytest.approx(0.5 * 59.5 / 150.0, rel=1e-4)
    with pytest.raises(ValueError, match="no square"):
        square_in_view(CAMERA, camera_over_table(0.05, np.pi / 2))


def test_pooled_pixels_look_where_their_blocks_do() -> None:
    """A grey image keeps one channel; a point keeps its ray; light is averaged, not stored values."""
    rgb = np.full((120, 160, 3), 60, np.uint8)
    rgb[:, 80:] = 200
    image, camera = pooled_image(rgb, CAMERA, 2.2)
    assert image.shape == (40, 53, 1)
    np.testing.assert_allclose(camera.rays(10, 20), CAMERA.rays(10 * 3 + 1, 20 * 3 + 1), atol=1e-12)
    dark, bright = (60 / 255) ** 2.2, (200 / 255) ** 2.2
    assert image[0, 26, 0] == pytest.approx((2 * dark + bright) / 3)
    coloured, _ = pooled_image(rgb * np.array([1, 0, 0], np.uint8), CAMERA, 2.2)
    assert coloured.shape[2] == 3


def test_blocks_that_are_clipped_tell_a_bound_alone() -> None:
    """More than half of four pixels at 255, or at 0; half of them do not."""
    camera = CameraIntrinsics(width=144, height=96, fx=150, fy=150, cx=71.5, cy=47.5)
    rgb = np.tile(np.array([90, 120, 150], np.uint8), (96, 144, 1))
    rgb[:2, :2, 0] = [[255, 255], [255, 90]]
    rgb[:2, 2:4, 1] = [[0, 0], [0, 0]]
    rgb[:2, 4:6, 2] = [[255, 255], [90, 90]]
    light, _ = pooled_image(rgb, camera, 1.0)
    assert light[0, 0, 0] == np.inf
    assert light[0, 1, 1] == -np.inf
    assert np.isfinite(light).sum() == light.size - 2
