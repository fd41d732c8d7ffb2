"""Objects of a parsed scene are judged one by one against the truth."""

import numpy as np
import pytest
import trimesh

from pipeline.evaluation.object_poses import MISSING_M
from pipeline.evaluation.scenes import object_errors
from recordings.truth import TrueObject

BOX = trimesh.creation.box((0.1, 0.2, 0.3))


def at(*place: float) -> np.ndarray:
    """A pose without a turn."""
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose


def test_instances_of_a_shape_are_matched_and_missing_objects_told() -> None:
    """In the truth's order, whatever that of the estimates."""
    names = (("left", "box", -0.5), ("right", "box", 0.5), ("gone", "can", 0.0))
    objects = [
        TrueObject(name=name, shape=shape, world_from_object=at(x, 0, 0), visible_fraction=0.7)
        for name, shape, x in names
    ]
    camera_from_world = at(0, 0, 2)
    estimates = [("box", at(0.5, 0, 2)), ("box", at(-0.5, 0, 2.5)), ("box", at(9, 0, 0))]
    errors = object_errors(objects, {"box": BOX, "can": BOX}, camera_from_world, estimates)

    assert [one.name for one in errors] == ["left", "right", "gone"]
    assert [one.found for one in errors] == [True, True, False]
    assert errors[0].add_s_m == pytest.approx(0.35, abs=0.15)
    assert errors[1].add_s_m == pytest.approx(0, abs=1e-9)
    assert errors[2].add_s_m == MISSING_M


def test_a_learned_shape_has_a_frame_of_its_own(seed: int) -> None:
    """Estimates are of that frame, the truth is of the object's."""
    shape_from_object = trimesh.transformations.random_rotation_matrix(
        np.random.default_rng(seed).uniform(size=3)
    )
    shape_from_object[:3, 3] = 0.1, 0.2, 0.3
    camera_from_object = at(0, 0, 1)
    one = TrueObject(name="box", shape="box", world_from_object=camera_from_object)
    estimates = [("box", np.asarray(camera_from_object @ np.linalg.inv(shape_from_object), np.float64))]
    errors = object_errors([one], {"box": BOX}, np.eye(4), estimates, {"box": shape_from_object})

    assert errors[0].add_s_m == pytest.approx(0, abs=1e-9)
