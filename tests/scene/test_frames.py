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
from scene.joint_search import JointStart
from scene.objects.scene_object import scene_object
from scene.parsing import parse_scene
from scene.presence.posterior import Presence
from scene.result import SceneResult

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=280.0, fy=280.0, cx=159.5, cy=119.5)
SIZES = {"wall": (0.24, 0.05, 0.2), "block": (0.07, 0.05, 0.06)}
PLACES_M = {"wall": (0.0, 0.0, 0.1), "block": (0.02, 0.1, 0.03)}


def look_at(position_m: tuple[float, float, float], x_m: float = 0.0) -> np.ndarray:
    """World_from_camera (4, 4) of a camera that looks at the table at x, in its middle if not told."""
    forward = np.array([x_m, 0.05, 0.05]) - position_m
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, np.array(position_m)], axis=1)
    return pose


MESHES = {name: trimesh.creation.box(size) for name, size in SIZES.items()}
CAMERAS = [look_at((0.0, -0.8, 0.25)), look_at((0.5, -0.5, 0.45)), look_at((0.75, 0.25, 0.5))]


APART_M = {"wall": (-0.6, 0.0, 0.1), "block": (0.6, 0.0, 0.03)}
ALONG = [look_at((x, -0.75, 0.45), x) for x in (-0.55, 0.55)]


def films(seed: int) -> list[Frame]:
    """A frame from each camera; the first does not show the block."""
    shown, frames = filmed(seed, PLACES_M, CAMERAS, 1.0)
    assert not (shown[0] == 2).any()
    assert (shown[2] == 2).sum() > 300
    return frames


def filmed(
    seed: int,
    places_m: dict[str, tuple[float, float, float]],
    cameras: list[np.ndarray],
    length_m: float,
) -> tuple[list[np.ndarray], list[Frame]]:
    """The parts that each camera sees of a table so long, the wall and the block; its frame."""
    table = Part(
        name="table",
        mesh=trimesh.creation.box((length_m, 1.0, 0.02)),
        world_from_part=trimesh.transformations.translation_matrix((0, 0, -0.01)),
    )
    parts = [table] + [
        Part(
            name=name,
            mesh=mesh,
            world_from_part=trimesh.transformations.translation_matrix(places_m[name]),
        )
        for name, mesh in MESHES.items()
    ]
    caster = RayCaster(parts)
    views = [caster.view(INTRINSICS, camera) for camera in cameras]
    rng = np.random.default_rng(seed)
    return [one.part for one in views], [
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


def assert_places(
    scene: SceneResult, camera: np.ndarray, places_m: dict[str, tuple[float, float, float]]
) -> None:
    """Both are found, by the mean and by the best sample, within 5 mm."""
    assert scene.found.all()
    for one, (name, mesh) in enumerate(MESHES.items()):
        true = np.linalg.inv(camera) @ trimesh.transformations.translation_matrix(places_m[name])
        assert add_s_m(model_points(mesh), true, scene.camera_from_object[one]) < 0.005
        assert add_s_m(model_points(mesh), true, scene.most_probable[one]) < 0.005


@pytest.mark.slow
def test_what_the_first_frame_hides_is_found_in_another(key: jax.Array, seed: int) -> None:
    """A block wholly behind a wall, seen from the side later: both within 5 mm in the first camera."""
    assert_places(parsed(key, films(seed), CAMERAS), CAMERAS[0], PLACES_M)


@pytest.mark.slow
def test_what_moves_put_in_has_a_pose(key: jax.Array, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The search rejects the block: presence tells that it is there, and chains where, within 5 mm."""
    search_frames = parsing.search_frames

    def without_block(*given: Any) -> JointStart:
        joint = search_frames(*given)
        start = replace(joint.start, found=joint.start.found & np.array([True, False]))
        return replace(joint, start=start)

    monkeypatch.setattr(parsing, "search_frames", without_block)
    assert_places(parsed(key, films(seed)[2:], CAMERAS[2:]), CAMERAS[2], PLACES_M)


@pytest.mark.slow
def test_nothing_rests_on_what_moves_leave_out(
    key: jax.Array, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A block on a wall that the search finds and moves do not: the wall carries nothing."""
    presence_in_scene = parsing.presence_in_scene

    def without_wall(*given: Any) -> Presence:
        return replace(presence_in_scene(*given), seen=np.array([False, True]))

    on_wall = PLACES_M | {"block": (0.02, 0.0, 0.23)}
    _, frames = filmed(seed, on_wall, CAMERAS[1:2], 1.0)
    assert parsed(key, frames, CAMERAS[1:2]).edge_probabilities[1, 0] > 0.5

    monkeypatch.setattr(parsing, "presence_in_scene", without_wall)
    again = jax.random.clone(key)
    assert parsed(again, frames, CAMERAS[1:2]).edge_probabilities[1, 0] == 0


@pytest.mark.slow
def test_things_that_no_frame_shows_together(key: jax.Array, seed: int) -> None:
    """A camera that goes along a table: the wall is in the first frame alone, the block in the second."""
    shown, frames = filmed(seed, APART_M, ALONG, 2.2)
    assert [bool((one == part).any()) for one in shown for part in (1, 2)] == [True, False, False, True]

    assert_places(parsed(key, frames, ALONG), ALONG[0], APART_M)
