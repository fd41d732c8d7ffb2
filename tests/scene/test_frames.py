"""Several frames of one scene: what one does not show, another does."""

import jax
import numpy as np
import pytest
import trimesh

from pipeline.evaluation.object_poses import add_s_m, model_points
from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics, DepthNoise, Frame
from scene.config import ParseConfig
from scene.objects.scene_object import scene_object
from scene.parsing import parse_scene

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


@pytest.mark.slow
def test_what_the_first_frame_hides_is_found_in_another(key: jax.Array, seed: int) -> None:
    """A block wholly behind a wall, seen from the side later: both within 5 mm in the first camera."""
    meshes = {name: trimesh.creation.box(size) for name, size in SIZES.items()}
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
        for name, mesh in meshes.items()
    ]
    caster = RayCaster(parts)
    cameras = [look_at((0.0, -0.8, 0.25)), look_at((0.5, -0.5, 0.45)), look_at((0.75, 0.25, 0.5))]
    views = [caster.view(INTRINSICS, camera) for camera in cameras]
    assert not (views[0].part == 2).any()
    assert (views[2].part == 2).sum() > 300
    rng = np.random.default_rng(seed)
    frames = [
        Frame(
            time_ns=index,
            depth_m=np.where(np.isfinite(view.depth_m), view.depth_m + rng.normal(0, 0.001, (240, 320)), 0)
            .clip(0)
            .astype(np.float32),
        )
        for index, view in enumerate(views)
    ]

    with jax.enable_x64(False):  # as the program starts it
        scene = parse_scene(
            key,
            frames,
            [0, 1, 2],
            np.linalg.inv(cameras[0]) @ np.stack(cameras),
            INTRINSICS,
            DepthNoise(),
            [scene_object(name, mesh.vertices, mesh.faces) for name, mesh in meshes.items()],
            ParseConfig(frames=(0, 1, 2), sweeps=60),
        )

    assert scene.found.all()
    for one, (name, mesh) in enumerate(meshes.items()):
        true = np.linalg.inv(cameras[0]) @ trimesh.transformations.translation_matrix(PLACES_M[name])
        assert add_s_m(model_points(mesh), true, scene.camera_from_object[one]) < 0.005
        assert add_s_m(model_points(mesh), true, scene.most_probable[one]) < 0.005
