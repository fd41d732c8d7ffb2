"""An object is looked at in more pixels than scenes are compared on, of the same image."""

import jax
import numpy as np
import trimesh

from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics, DepthNoise
from scene.config import ParseConfig
from scene.likelihood.object_renderer import ObjectRenderer
from scene.objects.scene_object import scene_object
from scene.objects.slots import OUT_OF_SIGHT
from scene.observation.segmentation import scene_data
from scene.search.hypotheses import PosePools
from scene.verification.object_crop import close_views
from shapes.geometry.poses import poses_of

INTRINSICS = CameraIntrinsics(width=320, height=240, fx=280.0, fy=280.0, cx=159.5, cy=119.5)
DOWNWARD = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.8], [0, 0, 0, 1]])
"""World_from_camera, 80 cm above the table."""


def test_every_object_in_sight_is_seen_closely(seed: int) -> None:
    """Two boxes far apart, a third out of sight: depth as foretold, the other box and the table behind it."""
    sizes_m = {"low": (0.06, 0.06, 0.04), "high": (0.05, 0.05, 0.1), "away": (0.05, 0.05, 0.05)}
    places = {"low": (-0.2, 0.1, 0.02), "high": (0.2, -0.1, 0.05)}
    meshes = {name: trimesh.creation.box(size) for name, size in sizes_m.items()}
    standing = {name: trimesh.transformations.translation_matrix(place) for name, place in places.items()}
    slab = trimesh.creation.box((1.0, 1.0, 0.02))
    below = trimesh.transformations.translation_matrix((0, 0, -0.01))
    parts = [Part(name="table", mesh=slab, world_from_part=below)]
    parts += [Part(name=name, mesh=meshes[name], world_from_part=pose) for name, pose in standing.items()]
    depth_m = RayCaster(parts).view(INTRINSICS, DOWNWARD).depth_m.astype(np.float32)
    data = scene_data(depth_m, INTRINSICS, seed)
    objects = [scene_object(name, mesh.vertices, mesh.faces) for name, mesh in meshes.items()]
    poses = np.tile(np.asarray(OUT_OF_SIGHT, np.float32), (3, 1, 1))
    poses[:2, 0] = poses_of(np.linalg.inv(DOWNWARD) @ np.stack(list(standing.values())))

    with jax.enable_x64(False):  # as the program starts it
        rng, renderer = np.random.default_rng(seed), ObjectRenderer.of(objects)
        pools = PosePools.of(data, objects, renderer, DepthNoise(), ParseConfig(), 1, rng).with_poses(
            poses, 0
        )
        views = close_views(pools, np.array([0, 0, 0]), DepthNoise())
        alone = close_views(pools, np.array([0, pools.absent, 0]), DepthNoise())

    assert set(views) == {0, 1}
    assert set(alone) == {0}
    for one, height_m in ((0, 0.04), (1, 0.1)):
        view = views[one]
        assert view.covers.sum() * view.weight > 0.9 * np.isfinite(pools.shown(np.zeros(3, int))[one]).sum()
        assert view.weight < 0.5
        top = view.covers & (np.abs(view.observed_m - (0.8 - height_m)) < 0.002)
        assert top.sum() > 0.5 * view.covers.sum()
        np.testing.assert_allclose(view.layer_m[top], view.observed_m[top], atol=0.002)
        assert np.isclose(view.rest_m[top], 0.8, atol=0.002).mean() > 0.8
        assert not (view.others_m < view.layer_m)[top].any()
