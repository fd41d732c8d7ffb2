"""Supports of a scene of which each camera shows a part."""

import numpy as np
import pytest
import trimesh

from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics
from scene.observation.frame_data import SceneData
from scene.observation.segmentation import scene_views

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=285.0, fy=285.0, cx=159.5, cy=119.5)
LENGTH_M, WIDTH_M, BLOCK_M, STEP_M = 2.0, 0.8, 0.08, 0.3


def part(name: str, size_m: tuple[float, float, float], middle_m: tuple[float, float, float]) -> Part:
    """A box at its middle."""
    place = trimesh.transformations.translation_matrix(middle_m)
    return Part(name=name, mesh=trimesh.creation.box(size_m), world_from_part=place)


def over(x_m: float) -> np.ndarray:
    """World_from_camera (4, 4) that looks down at 40 degrees on (x, 0, 0)."""
    forward = np.array([0.0, np.cos(0.7), -np.sin(0.7)])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([[1.0, 0.0, 0.0], np.cross(forward, [1.0, 0.0, 0.0]), forward], axis=1)
    pose[:3, 3] = np.array([x_m, 0.0, 0.0]) - 0.9 * forward
    return pose


CAMERAS = [over(-0.55), over(0.55)]
PARTS = [
    part("table", (LENGTH_M, WIDTH_M, 0.02), (0.0, 0.0, -0.01)),
    part("shelf", (0.5, 0.4, 0.02), (0.75, 0.1, STEP_M - 0.01)),
    part("left", (BLOCK_M, BLOCK_M, BLOCK_M), (-0.6, 0.0, BLOCK_M / 2)),
    part("middle", (BLOCK_M, BLOCK_M, BLOCK_M), (0.3, -0.1, BLOCK_M / 2)),
    part("upper", (BLOCK_M, BLOCK_M, BLOCK_M), (0.7, 0.05, STEP_M + BLOCK_M / 2)),
]


def seen(cameras: list[np.ndarray], blank: int | None = None) -> list[SceneData]:
    """The views of cameras in the frame of the first, one of them blank perhaps."""
    caster, rng = RayCaster(PARTS), np.random.default_rng(3)
    depths_m = []
    for number, camera in enumerate(cameras):
        depth_m = caster.view(INTRINSICS, camera).depth_m
        noisy_m = np.where(np.isfinite(depth_m), depth_m + rng.normal(0, 0.001, depth_m.shape), 0.0)
        depths_m.append((0.0 * noisy_m if number == blank else noisy_m).astype(np.float32))
    return scene_views(depths_m, np.linalg.inv(cameras[0]) @ np.stack(cameras), INTRINSICS, 1)


@pytest.mark.parametrize("blank", [None, 0])
def test_a_table_reaches_as_far_as_all_cameras_show_it(blank: int | None) -> None:
    """Its middle, normal and length to 2 cm, 1 degree and 5 cm in either camera, and the shelf of one.

    The first camera may as well show nothing.
    """
    cameras = CAMERAS if blank is None else [CAMERAS[0], *CAMERAS]

    views = seen(cameras, blank)

    for view, camera in zip(views, cameras, strict=True):
        assert len(view.supports) == 2
        heights_m = []
        for support in view.supports:
            in_world = camera @ support.camera_from_table
            assert in_world[2, 2] > np.cos(np.deg2rad(1.0))
            heights_m.append(in_world[2, 3])
        np.testing.assert_allclose(heights_m, [0.0, STEP_M], atol=0.01)
        table = view.supports[0]
        assert 2 * table.half_size_m.max() == pytest.approx(LENGTH_M, abs=0.05)
        np.testing.assert_allclose((camera @ table.camera_from_table)[:2, 3], 0.0, atol=0.02)


def test_foreground_is_what_stands_wherever_a_camera_shows_it() -> None:
    """Each view's foreground holds its blocks but for their rims, and nothing of the table."""
    caster = RayCaster(PARTS)

    for view, camera in zip(seen(CAMERAS), CAMERAS, strict=True):
        shown = caster.view(INTRINSICS, camera).part
        blocks = shown >= PARTS.index(PARTS[2])
        assert blocks.sum() > 200
        assert view.foreground[blocks].mean() > 0.85
        assert not view.foreground[shown == 0].any()
