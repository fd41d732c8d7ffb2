"""The line about which most of a shape is round, and turns about it."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from scene.objects.scene_object import scene_object
from scene.objects.symmetry import turns_alike

RADIUS_M, HEIGHT_M = 0.04, 0.09


def mug() -> trimesh.Trimesh:
    """A cylinder with a handle on the side of +x."""
    handle = trimesh.creation.box((0.03, 0.012, 0.06))
    handle.apply_translation((RADIUS_M + 0.012, 0, 0))
    body = trimesh.creation.cylinder(radius=RADIUS_M, height=HEIGHT_M, sections=64)
    both = trimesh.util.concatenate([body, handle])
    assert isinstance(both, trimesh.Trimesh)
    return both


def test_a_mug_spins_about_the_axis_of_its_body(seed: int) -> None:
    """Wherever its frame is: within 1 degree and 0.5 mm, though the handle moves the box's middle."""
    mesh = mug()
    turn = Rotation.random(rng=np.random.default_rng(seed))
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = turn.as_matrix(), (0.3, -0.2, 0.1)
    mesh.apply_transform(placed)

    one = scene_object("mug", mesh.vertices, mesh.faces)

    object_from_box = np.linalg.inv(one.box_from_object)
    direction, point = one.spin_line @ object_from_box[:3, :3].T
    assert abs(direction @ turn.apply([0, 0, 1])) > np.cos(np.radians(1))
    off = one.centre_m + point - placed[:3, 3]
    assert np.linalg.norm(off - off @ direction * direction) < 0.0005
    assert not one.spins_freely


@pytest.mark.parametrize(("radius_m", "height_m"), [(0.03, 0.1), (0.15, 0.4)])
@pytest.mark.parametrize("axes", [[0, 1, 2, 3], [1, 2, 0, 3]])
def test_a_can_spins_freely(axes: list[int], radius_m: float, height_m: float) -> None:
    """Whichever its axis is, and a bin as well."""
    mesh = trimesh.creation.cylinder(radius_m, height_m, sections=96, transform=np.eye(4)[axes])
    assert scene_object("can", mesh.vertices, mesh.faces).spins_freely


@pytest.mark.parametrize("extents", [(0.1, 0.1, 0.2), (0.1, 0.1, 0.02), (0.05, 0.06, 0.07)])
def test_a_box_spins_about_nothing(extents: tuple[float, float, float]) -> None:
    """Not even a square one, nor a flat one, whose large faces any turn leaves in place."""
    mesh = trimesh.creation.box(extents)
    assert not scene_object("box", mesh.vertices, mesh.faces).spin_line.any()


def test_turns_alike_leave_a_box_as_it_is() -> None:
    """Four of a box with three different edges, eight of a square one and with the first none."""
    for extents, count in (((0.1, 0.07, 0.2), 4), ((0.1, 0.1, 0.2), 8)):
        mesh = trimesh.creation.box(extents)
        one = scene_object("box", mesh.vertices, mesh.faces)
        turns = turns_alike(one.symmetry_lines, one.symmetry_orders, np.zeros((2, 3)))
        np.testing.assert_array_equal(turns[0], np.eye(4))
        assert len(np.unique((turns[:, :3, :3] + 0.0).round(2), axis=0)) == count
        for turn in turns:
            turned = np.abs(one.points_m @ turn[:3, :3].T + turn[:3, 3])
            np.testing.assert_allclose(turned.max(axis=0), one.half_extents_m, atol=0.001)


def test_turns_alike_spin_a_mug() -> None:
    """Once round its line, whose points stay, with steps of 30 degrees."""
    one = scene_object("mug", (mesh := mug()).vertices, mesh.faces)
    turns = turns_alike(np.zeros((3, 2, 3)), np.zeros(3, int), one.spin_line)
    np.testing.assert_allclose(
        turns[:, :3, :3] @ one.spin_line[1] + turns[:, :3, 3], np.tile(one.spin_line[1], (12, 1))
    )
    angles = Rotation.from_matrix(turns[:, :3, :3]).as_rotvec() @ one.spin_line[0]
    np.testing.assert_allclose(np.sort(np.degrees(angles) % 360), np.arange(12) * 30, atol=1e-6)
