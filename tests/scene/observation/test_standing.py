"""A small top over a floor: what stands on it, what stands on the floor, and what is furniture."""

from collections.abc import Mapping
from itertools import product
from types import MappingProxyType

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from recordings.types import NO_RETURN, CameraIntrinsics
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import scene_data

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=280.0, fy=280.0, cx=159.5, cy=119.5)
TOP_M = 0.5
CAMERA_FROM_FLOOR = np.array([[1, 0, 0, 0.0], [0, -0.6, -0.8, 0.45], [0, 0.8, -0.6, 1.2], [0, 0, 0, 1.0]])
FURNITURE = {
    "floor": ((0.0, 0.5, -0.01), (3.0, 3.0, 0.01), 0.0),
    "top": ((0.0, 0.0, TOP_M - 0.02), (0.25, 0.25, 0.02), np.pi / 4),
    "leg": ((0.0, 0.0, 0.2), (0.03, 0.03, 0.3), 0.0),
    "wardrobe": ((0.5, 0.9, 0.6), (0.2, 0.2, 0.6), 0.0),
    "board": ((-0.6, 0.7, 0.2), (0.2, 0.01, 0.2), 0.0),
}
THINGS = {
    "on the top": ((0.05, 0.02, TOP_M + 0.05), (0.05, 0.04, 0.05), 0.3),
    "on the floor": ((-0.45, 0.2, 0.06), (0.05, 0.05, 0.06), 0.0),
}


def seen(centre_m: tuple[float, ...], half_m: tuple[float, ...], yaw_rad: float) -> NDArray[np.float64]:
    """Depth (H, W) of a box in the floor's frame, +inf beside it."""
    rays = INTRINSICS.rays(np.arange(320)[None, :], np.arange(240)[:, None])
    turn = np.array(
        [[np.cos(yaw_rad), -np.sin(yaw_rad), 0], [np.sin(yaw_rad), np.cos(yaw_rad), 0], [0, 0, 1.0]]
    )
    floor_from_camera = np.linalg.inv(CAMERA_FROM_FLOOR)
    start = turn.T @ (floor_from_camera[:3, 3] - centre_m)
    along = rays @ floor_from_camera[:3, :3].T @ turn
    sides = np.stack([(-np.array(half_m) - start) / along, (np.array(half_m) - start) / along])
    enters, leaves = sides.min(axis=0).max(axis=-1), sides.max(axis=0).min(axis=-1)
    return np.where((enters < leaves) & (enters > 0), enters, np.inf)


def of_image(
    region: tuple[float, ...] = (), more: Mapping[str, tuple] = MappingProxyType({})
) -> tuple[dict[str, NDArray[np.bool_]], SceneData]:
    """The pixels of every part, `more` boxes among them, and the frame."""
    layers = {name: seen(*box) for name, box in {**FURNITURE, **THINGS, **more}.items()}
    depth_m = np.min(list(layers.values()), axis=0)
    parts = {name: np.isfinite(layer) & (layer == depth_m) for name, layer in layers.items()}
    rng = np.random.default_rng(0)
    noisy_m = np.where(np.isfinite(depth_m), depth_m + rng.normal(0, 0.001, depth_m.shape), NO_RETURN)
    return parts, scene_data(noisy_m.astype(np.float32), INTRINSICS, 1, region=region)


@pytest.fixture(scope="module")
def parts_and_data() -> tuple[dict[str, NDArray[np.bool_]], SceneData]:
    """The pixels of every part, and the frame."""
    return of_image()


def test_a_top_seen_over_a_corner_is_the_first_support(
    parts_and_data: tuple[dict[str, NDArray[np.bool_]], SceneData],
) -> None:
    """Its rectangle is as large as it is; a floor that carries less comes after it."""
    _, data = parts_and_data

    heights_m = [(np.linalg.inv(CAMERA_FROM_FLOOR) @ one.camera_from_table)[2, 3] for one in data.supports]
    np.testing.assert_allclose(heights_m, [TOP_M, 0.0], atol=0.01)
    np.testing.assert_allclose(data.supports[0].half_size_m, 0.25, atol=0.02)


def test_things_on_any_support_are_foreground_and_furniture_is_not(
    parts_and_data: tuple[dict[str, NDArray[np.bool_]], SceneData],
) -> None:
    """All but the rims of things; of what is no thing next to nothing."""
    parts, data = parts_and_data

    shares = {
        name: data.near[np.asarray(binary_erosion(part, iterations=3), bool)].mean()
        for name, part in parts.items()
    }

    assert min(shares[name] for name in THINGS) > 0.9, shares
    assert max(shares[name] for name in FURNITURE) < 0.01, shares


def test_the_search_begins_with_things_that_are_seen_whole() -> None:
    """What is on a support and larger than things are may be searched for things in the end."""
    chest = (0.02, 0.16, TOP_M + 0.24), (0.12, 0.06, 0.24), 0.0

    parts, data = of_image(more={"chest": chest})

    shares = {
        name: np.array([mask[part].mean() for mask in (data.foreground, data.compact)])
        for name, part in parts.items()
    }
    assert min(shares[name][1] for name in THINGS) > 0.8, shares
    assert shares["chest"][0] > 0.8, shares
    assert shares["chest"][1] == 0, shares


def test_a_region_chooses_the_support_on_which_most_stands_there() -> None:
    """With the top left out it is the floor, and what stands on it there is all that is foreground."""
    centre_m, half_m, _ = THINGS["on the floor"]
    corners_m = [np.array(centre_m) + 1.1 * np.array(half_m) * signs for signs in product((-1, 1), repeat=3)]
    seen_m = np.array(corners_m) @ CAMERA_FROM_FLOOR[:3, :3].T + CAMERA_FROM_FLOOR[:3, 3]
    low_m, high_m = seen_m.min(axis=0), seen_m.max(axis=0)

    parts, data = of_image((*low_m, *high_m))

    height_m = (np.linalg.inv(CAMERA_FROM_FLOOR) @ data.supports[0].camera_from_table)[2, 3]
    assert abs(height_m) < 0.01
    assert data.near[parts["on the floor"]].mean() > 0.9
    assert not data.near[parts["on the top"]].any()
