"""The table of a depth image, and what may stand on it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from recordings.types import NO_RETURN, CameraIntrinsics
from scene.observation.segmentation import near_share, scene_data

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
CAMERA_FROM_TABLE = np.array([[1, 0, 0, 0.0], [0, -0.6, -0.8, 0.0], [0, 0.8, -0.6, 0.9], [0, 0, 0, 1.0]])
BLOCK_M = 0.08


def seen_plane(height_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) of the level plane at a height over the table's, and the table's coordinates (H, W, 2)."""
    rays = INTRINSICS.rays(np.arange(320)[None, :], np.arange(240)[:, None])
    normal = CAMERA_FROM_TABLE[:3, 2]
    origin = CAMERA_FROM_TABLE[:3, 3] + height_m * normal
    depth_m = (normal @ origin) / (rays @ normal)
    return depth_m, ((rays * depth_m[..., None] - origin) @ CAMERA_FROM_TABLE[:3, :2])


def image(squares_m: float, gaps_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) of squares in a plane with nothing between them and a lid over them; the lid's mask."""
    depth_m, places_m = seen_plane(0.0)
    extent = (np.abs(places_m) < 0.28).all(axis=-1)
    square = (np.mod(places_m, squares_m + gaps_m) < squares_m).all(axis=-1)
    depth_m = np.where(extent & square, depth_m, NO_RETURN)
    lid_m, places_m = seen_plane(BLOCK_M)
    lid = np.asarray((np.abs(places_m) < 0.05).all(axis=-1))
    return np.where(lid, lid_m, depth_m).astype(np.float32), lid


def test_what_is_over_a_table_is_foreground() -> None:
    """The lid but for its rim of a pixel, and not the table, which is the background behind it."""
    depth_m, lid = image(squares_m=1.0, gaps_m=0.0)

    data = scene_data(depth_m, INTRINSICS, 1)

    assert data.table is not None
    np.testing.assert_allclose(data.table.camera_from_table[:3, 2], CAMERA_FROM_TABLE[:3, 2], atol=0.01)
    assert not (data.foreground & ~lid).any()
    inner = np.asarray(binary_erosion(lid), bool)
    assert data.foreground[inner].all()
    behind = data.window.of(inner)
    np.testing.assert_allclose(data.rest_m[behind], data.window.of(seen_plane(0.0)[0])[behind], atol=0.003)


def test_things_in_the_air_have_no_table() -> None:
    """A plane through many of them is none if most of what is behind it can be seen; all is foreground."""
    depth_m, _ = image(squares_m=0.04, gaps_m=0.03)

    data = scene_data(depth_m, INTRINSICS, 1)

    assert data.table is None
    np.testing.assert_array_equal(data.foreground, depth_m != NO_RETURN)
    foreground = data.window.of(depth_m) != NO_RETURN
    assert np.isinf(data.rest_m[foreground]).all()


def test_a_table_that_the_image_cuts_off_goes_on() -> None:
    """A level camera sees the floor from 1 m on; a block across that line is foreground as a whole."""
    x, y, _ = np.moveaxis(INTRINSICS.rays(np.arange(320)[None, :], np.arange(240)[:, None]), -1, 0)
    floor_m = np.where(y > 0.25, 0.4 / np.maximum(y, 1e-6), NO_RETURN)
    top_m = 0.25 / np.maximum(y, 1e-6)
    top = (top_m > 0.85) & (top_m < 1.05) & (np.abs(x * top_m) < 0.1)
    face = (np.abs(x * 0.85) < 0.1) & (y * 0.85 > 0.25)
    depth_m = np.where(face, 0.85, np.where(top, top_m, floor_m)).astype(np.float32)

    data = scene_data(depth_m, INTRINSICS, 1)

    assert data.table is not None
    np.testing.assert_allclose(data.table.camera_from_table[:3, 2], [0, -1, 0], atol=0.01)
    assert data.foreground[np.asarray(binary_erosion(face | top), bool)].all()
    assert not (data.foreground & ~(face | top)).any()


def test_a_level_camera_sees_a_given_table_up_to_its_horizon() -> None:
    """Rays of one row run along the table: neither they nor those above meet it, without a warning."""
    camera = replace(INTRINSICS, cy=120.0)
    down = camera.rays(np.arange(320)[None, :], np.arange(240)[:, None])[..., 1]
    depth_m = np.where(down > 0.2, 0.2 / np.maximum(down, 0.2), NO_RETURN).astype(np.float32)
    depth_m[90:180, 140:180] = 0.6

    data = scene_data(depth_m, camera, 1, support=(0.0, 0.2, 0.7, 0.0, -1.0, 0.0))

    rows = data.window.rows
    assert np.isinf(data.support_m[rows <= 120]).all()
    assert np.isfinite(data.support_m[rows > 190]).any()
    assert data.foreground[100:170, 145:175].all()


def test_a_given_support_and_region_are_taken() -> None:
    """The block's lid as the support has its place and size; nothing outside the region is foreground."""
    depth_m, lid = image(squares_m=1.0, gaps_m=0.0)
    normal = CAMERA_FROM_TABLE[:3, 2]
    top = tuple(CAMERA_FROM_TABLE[:3, 3] + BLOCK_M * normal) + tuple(normal)

    on_lid = scene_data(depth_m, INTRINSICS, 1, support=top)
    left_half = scene_data(depth_m, INTRINSICS, 1, region=(-1.0, -1.0, 0.0, 0.0, 1.0, 2.0))

    assert on_lid.table is not None
    np.testing.assert_allclose(on_lid.table.half_size_m, 0.05, atol=0.004)
    assert not (on_lid.near & lid).any()
    assert left_half.near[:, :155].any()
    assert not left_half.near[:, 161:].any()
    with pytest.raises(ValueError, match="region"):
        scene_data(depth_m, INTRINSICS, 1, region=(-1.0, -1.0, 0.0, 1.0, 1.0, 0.1))


@pytest.mark.parametrize("solid", [True, False], ids=["a body", "a board in the air"])
def test_what_carries_things_has_sides_where_they_are_seen(solid: bool) -> None:
    """Down to the table under a lid as wide as a tray, holes included; not where the table shows behind them.

    The lid's rectangle, between percentiles of its points, is up to 4 mm narrower.
    """
    table_m, places_m = seen_plane(0.0)
    depth_m = np.where((np.abs(places_m) < 0.28).all(axis=-1), table_m, NO_RETURN)
    lid_m, places_m = seen_plane(BLOCK_M)
    lid = (np.abs(places_m) < [0.14, 0.11]).all(axis=-1)
    rays = INTRINSICS.rays(np.arange(320)[None, :], np.arange(240)[:, None])
    across, origin = CAMERA_FROM_TABLE[:3, 1], CAMERA_FROM_TABLE[:3, 3]
    side_m = (across @ origin - 0.11) / (rays @ across)
    places_m = (rays * side_m[..., None] - origin) @ CAMERA_FROM_TABLE[:3, :3]
    side = (np.abs(places_m[..., 0]) < 0.14) & (places_m[..., 2] > 0) & (places_m[..., 2] < BLOCK_M)
    seen_m = np.where(lid, lid_m, np.where(side & solid, side_m, depth_m)).astype(np.float32)
    seen_m[side & solid & (np.arange(seen_m.size).reshape(seen_m.shape) % 5 == 0)] = NO_RETURN

    data = scene_data(seen_m, INTRINSICS, 1)

    assert len(data.supports) == 2
    inner = np.asarray(binary_erosion(side, iterations=3), bool) & (table_m > side_m + 0.04)
    expected_m = side_m if solid else table_m
    assert inner.sum() > 1000
    within = data.window.of(inner)
    np.testing.assert_allclose(data.support_m[within], data.window.of(expected_m)[within], atol=0.006)


def test_how_much_of_an_image_is_near_enough() -> None:
    """Of its returns; an image of nothing shows nothing near."""
    depth_m = np.full((4, 5), NO_RETURN, np.float32)
    assert near_share(depth_m) == 0
    depth_m[0] = 2.0
    depth_m[1:4] = 3.0
    assert near_share(depth_m) == 0.25
