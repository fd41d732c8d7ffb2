"""Several frames of one scene: what one does not show, another does."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest
import trimesh

from pipeline.evaluation.object_poses import add_s_m, model_points
from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics, DepthNoise, Frame
from scene import parsing
from scene.config import ParseConfig
from scene.objects.scene_object import scene_object
from scene.parsing import parse_scene
from scene.result import SceneResult
from scene.search.search_result import Initialisation

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=280.0, fy=280.0, cx=159.5, cy=119.5)
SIZES = {"wall": (0.24, 0.05, 0.2), "block": (0.07, 0.05, 0.06)}
PLACES_M = {"wall": (0.0, 0.0, 0.1), "block": (0.02, 0.1, 0.03)}


def look_at(position_m: tuple[float, float, float]) -> np.ndarray:
    """World_from_camera (4, 4) of a camera that looks at the middle of the table."""
    forward = np.array([0.0, 0.05, 0.05]) - position_m
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, np.array(position_m)], axis=1)
    return pose


MESHES = {name: trimesh.creation.box(size) for name, size in SIZES.items()}
CAMERAS = [look_at((0.0, -0.8, 0.25)), look_at((0.5, -0.5, 0.45)), look_at((0.75, 0.25, 0.5))]


def films(seed: int) -> list[Frame]:
    """A frame from each camera; the first does not show the block."""
    table = Part(
        name="table",
        mesh=trimesh.creation.box((1.0, 1.0, 0.02)),
        world_from_part=trimesh.transformations.translation_matrix((0, 0, -0.01)),
    )
    parts = [table] + [
        Part(
            name=name,
            mesh=mesh,
            world_from_part=trimesh.transformations.translation_matrix(PLACES_M[name]),
        )
        for name, mesh in MESHES.items()
    ]
    caster = RayCaster(parts)
    views = [caster.view(INTRINSICS, camera) for camera in CAMERAS]
    assert not (views[0].part == 2).any()
    assert (views[2].part == 2).sum() > 300
    rng = np.random.default_rng(seed)
    return [
        Frame(
            time_ns=index,
            depth_m=np.where(np.isfinite(view.depth_m), view.depth_m + rng.normal(0, 0.001, (240, 320)), 0)
            .clip(0)
            .astype(np.float32),
        )
        for index, view in enumerate(views)
    ]


def parsed(key: jax.Array, frames: list[Frame], cameras: list[np.ndarray]) -> SceneResult:
    """The scene in the first of these frames' camera."""
    with jax.enable_x64(False):  # as the program starts it
        return parse_scene(
            key,
            frames,
            list(range(len(frames))),
            np.linalg.inv(cameras[0]) @ np.stack(cameras),
            INTRINSICS,
            DepthNoise(),
            [scene_object(name, mesh.vertices, mesh.faces) for name, mesh in MESHES.items()],
            ParseConfig(frames=tuple(range(len(frames))), sweeps=60),
        )


def assert_places(scene: SceneResult, camera: np.ndarray) -> None:
    """Both are found, by the mean and by the best sample, within 5 mm."""
    assert scene.found.all()
    for one, (name, mesh) in enumerate(MESHES.items()):
        true = np.linalg.inv(camera) @ trimesh.transformations.translation_matrix(PLACES_M[name])
        assert add_s_m(model_points(mesh), true, scene.camera_from_object[one]) < 0.005
        assert add_s_m(model_points(mesh), true, scene.most_probable[one]) < 0.005


@pytest.mark.slow
def test_what_the_first_frame_hides_is_found_in_another(key: jax.Array, seed: int) -> None:
    """A block wholly behind a wall, seen from the side later: both within 5 mm in the first camera."""
    assert_places(parsed(key, films(seed), CAMERAS), CAMERAS[0])


@pytest.mark.slow
def test_what_moves_put_in_has_a_pose(key: jax.Array, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The search rejects the block: presence tells that it is there, and chains where, within 5 mm."""
    best_start = parsing._best_start

    def without_block(*given: Any) -> tuple[int, Initialisation]:
        number, start = best_start(*given)
        return number, replace(start, found=start.found & np.array([True, False]))

    monkeypatch.setattr(parsing, "_best_start", without_block)
    assert_places(parsed(key, films(seed)[2:], CAMERAS[2:]), CAMERAS[2])
