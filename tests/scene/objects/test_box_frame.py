"""The box about an object lies along its faces, however its mesh is turned."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from scene.objects.scene_object import scene_object


def test_a_turned_box_is_boxed_along_its_faces() -> None:
    """Half sizes, and axes along faces within rounding; the turn is the least that does so."""
    mesh = trimesh.creation.box((0.11, 0.09, 0.035))
    placed = np.eye(4)
    placed[:3, :3] = Rotation.from_euler("z", 28, degrees=True).as_matrix()
    placed[:3, 3] = 0.2, -0.1, 0.4
    mesh.apply_transform(placed)

    one = scene_object("box", mesh.vertices, mesh.faces)

    np.testing.assert_allclose(one.half_extents_m, (0.055, 0.045, 0.0175), atol=1e-9)
    np.testing.assert_allclose(one.box_from_object @ placed, np.eye(4), atol=1e-9)
    assert np.abs(one.points_m).max(axis=0) == pytest.approx(one.half_extents_m, abs=1e-4)


def test_a_can_keeps_its_axes() -> None:
    """No box about it is much smaller than that along its axis, so that none is turned."""
    mesh = trimesh.creation.cylinder(0.033, 0.1, sections=60)
    one = scene_object("can", mesh.vertices, mesh.faces)
    np.testing.assert_array_equal(one.box_from_object[:3, :3], np.eye(3))


def test_what_is_flat_is_refused() -> None:
    """One sheet spans no box."""
    corners = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]])
    with pytest.raises(ValueError, match="no extent"):
        scene_object("sheet", corners, np.array([[0, 1, 2], [1, 3, 2]]))
