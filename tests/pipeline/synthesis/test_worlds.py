"""Worlds hold what they are said to hold."""

import numpy as np
import pytest
import trimesh

from pipeline.synthesis.objects import built_in_object
from pipeline.synthesis.scenarios import CameraConfig
from pipeline.synthesis.worlds import World, WorldScene, film_world

SHAPES = {name: built_in_object(name) for name in ("box", "can", "bracket", "mug")}
OTHERS = {"cone": trimesh.creation.cone(0.03, 0.09), "rod": trimesh.creation.cylinder(0.02, 0.12)}
SCENE = WorldScene(camera=CameraConfig(width=160, height=120), objects=2, unasked=1, absent=1)


@pytest.fixture(scope="module")
def world() -> World:
    """One of them."""
    return film_world(SHAPES, OTHERS, SCENE, 4)


def test_the_truth_holds_what_is_asked_for_and_there(world: World) -> None:
    """Two of the shapes; the absent one is a third; the unasked thing is in the image's world alone."""
    there = [one.shape for one in world.recording.truth.objects]
    assert len(set(there)) == 2
    assert set(there) <= set(SHAPES)
    assert len(world.absent) == 1
    assert not set(world.absent) & set(there)
    assert any((one.visible_fraction or 0) > 0 for one in world.recording.truth.objects)


def test_there_is_a_floor_below_a_small_table(world: World) -> None:
    """The camera sees the table's top, and much that lies below it."""
    plane = world.recording.truth.support_plane
    assert plane is not None
    frame, pose = world.recording.frame(0), world.recording.trajectory.reference_from_camera[0]
    rows, columns = np.nonzero(frame.depth_m > 0)
    rays = world.recording.intrinsics.rays(columns, rows)
    points = trimesh.transform_points(rays * frame.depth_m[rows, columns, None], pose)
    height = points @ plane[:3] + plane[3]
    assert (height < -0.2).mean() > 0.1
    assert (np.abs(height) < 0.02).mean() > 0.02


def test_worlds_repeat_and_differ(world: World) -> None:
    """By their seed."""
    again, other = film_world(SHAPES, OTHERS, SCENE, 4), film_world(SHAPES, OTHERS, SCENE, 5)
    frame = world.recording.frame(0)
    np.testing.assert_array_equal(again.recording.frame(0).depth_m, frame.depth_m)
    assert again.absent == world.absent
    assert not np.array_equal(other.recording.frame(0).depth_m, frame.depth_m)
