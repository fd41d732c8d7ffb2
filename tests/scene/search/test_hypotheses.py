"""What the search holds against poses before it looks at the image."""

from typing import Literal

import jax
import numpy as np
import pytest
import trimesh

from pipeline.synthesis.world import Part, RayCaster
from recordings.types import CameraIntrinsics, DepthNoise
from scene.config import ParseConfig
from scene.likelihood.object_renderer import ObjectRenderer
from scene.objects.scene_object import scene_object
from scene.observation.segmentation import scene_data
from scene.search.hypotheses import PosePools
from shapes.geometry.poses import poses_of

INTRINSICS = CameraIntrinsics(width=160, height=120, fx=140.0, fy=140.0, cx=79.5, cy=59.5)
DOWNWARD = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.8], [0, 0, 0, 1]])
"""World_from_camera, 80 cm above the table."""
EDGE_M = 0.06


def pools_of_boxes(
    graph: Literal["infer", "fixed"], seed: int, copies: int = 1
) -> tuple[PosePools, np.ndarray]:
    """Pools of boxes over a table, and a standing and a hanging pose, of which the image shows the latter."""
    mesh = trimesh.creation.box((EDGE_M,) * 3)
    slab = trimesh.creation.box((1.0, 1.0, 0.02))
    heights_m = (EDGE_M / 2, EDGE_M / 2 + 0.2)
    places = [trimesh.transformations.translation_matrix((0, 0, height)) for height in heights_m]
    below = trimesh.transformations.translation_matrix((0, 0, -0.01))
    table = Part(name="table", mesh=slab, world_from_part=below)
    hangs = Part(name="box", mesh=mesh, world_from_part=places[1])
    depth_m = RayCaster([table, hangs]).view(INTRINSICS, DOWNWARD).depth_m
    boxes = [scene_object("box", mesh.vertices, mesh.faces)] * copies
    data = scene_data(depth_m.astype(np.float32), INTRINSICS, seed)
    assert data.table is not None
    poses = poses_of(np.linalg.inv(DOWNWARD) @ np.stack(places)).astype(np.float32)
    config = ParseConfig(graph=graph)
    return PosePools.of(data, boxes, ObjectRenderer.of(boxes), DepthNoise(), config, 2), poses


@pytest.mark.parametrize(("graph", "costs"), [("infer", True), ("fixed", False)])
def test_only_graphs_in_which_things_rest_make_floating_costly(
    graph: Literal["infer", "fixed"], costs: bool, seed: int
) -> None:
    """A box that stands on the table, and one 20 cm above it: with every object floating both are alike."""
    with jax.enable_x64(False):  # as the program starts it
        pools, poses = pools_of_boxes(graph, seed)
        standing, hanging = np.asarray(pools.with_poses(poses[None], 0).layers.rests.log_alone)[0, :2]

    assert standing == pytest.approx(0, abs=0.1)
    assert hanging < -1 if costs else hanging == 0


def test_poses_of_one_object_leave_those_of_others(seed: int) -> None:
    """Put in one object after the other, or all at once, they have the same layers and priors."""
    with jax.enable_x64(False):
        pools, poses = pools_of_boxes("infer", seed, copies=2)
        at_once = pools.with_poses(np.stack([poses, poses[::-1]]), 0)
        first = pools.with_poses(poses[None], 0, [0])
        one_by_one = first.with_poses(poses[None, ::-1], 0, [1])

    assert np.isfinite(at_once.layers.depth_m[:, :2]).any(axis=-1).all()
    np.testing.assert_array_equal(first.poses[1], pools.poses[1])
    for mine, other in zip(jax.tree.leaves(one_by_one.layers), jax.tree.leaves(at_once.layers), strict=True):
        np.testing.assert_array_equal(mine, other)
