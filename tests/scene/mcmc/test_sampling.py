"""The target of `parse` allows the scenes from which its chains start."""

import numpy as np
import trimesh

from scene.mcmc.chain_model import carrying, prior_space
from scene.objects.scene_object import scene_object
from scene.objects.slots import OUT_OF_SIGHT
from scene.observation.detection import SupportPlane
from scene.search.search_result import Initialisation
from shapes.geometry.poses import poses_of
from tests.scene.observation.test_detection import CAMERA_FROM_TABLE


def test_chains_start_where_objects_can_be() -> None:
    """The cuboid holds the table's own space and every start, over the table or far from it."""
    table = SupportPlane(camera_from_table=np.eye(4), half_size_m=np.array([0.4, 0.3]), bend=np.zeros(6))
    starts = np.array([[0.1, 0.2, 0.05], [1.2, -0.9, 0.8]])
    for support in (table, None):
        low, high = prior_space(support, starts)
        assert ((starts > low) & (starts < high)).all()
        none_low, none_high = prior_space(support, np.empty((0, 3)))
        assert (low <= none_low).all()
        assert (high >= none_high).all()
        assert np.isfinite([none_low, none_high]).all()


def test_supports_that_carry_nothing_are_left_out() -> None:
    """A cube stands on a shelf 30 cm over the table; the floor below and a shelf beside it carry nothing."""

    def support(height_m: float, x_m: float = 0.0) -> SupportPlane:
        pose = CAMERA_FROM_TABLE.copy()
        pose[:3, 3] += CAMERA_FROM_TABLE[:3, :3] @ [x_m, 0.0, height_m]
        return SupportPlane(camera_from_table=pose, half_size_m=np.array([0.2, 0.15]), bend=np.zeros(6))

    cube = trimesh.creation.box((0.06, 0.06, 0.06))
    one = scene_object("cube", cube.vertices, cube.faces)
    pose = CAMERA_FROM_TABLE.copy()
    pose[:3, 3] += 0.335 * CAMERA_FROM_TABLE[:3, 2]
    start = Initialisation(
        poses=np.stack([poses_of(pose), np.array(OUT_OF_SIGHT)]),
        found=np.array([True, False]),
        rivals=np.zeros((2, 7)),
        pools=np.zeros((2, 0, 7)),
        log_gains=np.zeros((2, 1)),
        log_alone=np.zeros((2, 1)),
    )
    table, floor, shelf, beside = support(0.0), support(-0.7), support(0.3), support(0.3, 0.5)

    left = carrying([table, floor, shelf, beside], [one, one], start)

    assert left == [table, shelf]
