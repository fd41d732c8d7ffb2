"""Filmed scenes hold their objects where the truth says, alike at each reading."""

from typing import Literal

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipeline.synthesis.colours import shape_colour
from pipeline.synthesis.filming import film_object, film_table
from pipeline.synthesis.objects import built_in_names, built_in_object
from pipeline.synthesis.paths import PathConfig
from pipeline.synthesis.recording import SyntheticRecording
from pipeline.synthesis.rooms import RoomConfig
from pipeline.synthesis.scenarios import CameraConfig, ObjectScene, TableScene
from pipeline.synthesis.sensor import DepthSensor
from pipeline.synthesis.world import Part, RayCaster
from recordings.truth import TABLE

SMALL = CameraConfig(width=160, height=120)
SHORT = PathConfig(frames=3, radius_m=0.7)


@pytest.fixture(scope="module")
def table() -> SyntheticRecording:
    """A noise-free table of five objects, one of them stacked, with clutter."""
    scene = TableScene(
        camera=SMALL,
        path=SHORT,
        room=RoomConfig(kind="bare"),
        stacked_share=0.2,
        clutter=2,
        sensor=DepthSensor(noise_free=True),
    )
    return film_table({name: built_in_object(name) for name in built_in_names()}, scene, 3)


@pytest.mark.parametrize("support", ["pedestal", "floating"])
def test_a_filmed_object_lies_where_the_truth_says(support: str) -> None:
    """Noise-free points near the object lie on its true surface, and there are many of them."""
    mesh = built_in_object("mug")
    scene = ObjectScene(
        camera=SMALL,
        path=SHORT,
        support=support,  # type: ignore[arg-type]
        sensor=DepthSensor(noise_free=True),
    )
    recording = film_object("mug", mesh, scene, 5)
    truth = recording.truth.objects[0]

    assert truth.visible_fraction == 1
    assert (truth.parent, recording.truth.support_plane is None) in ((TABLE, False), (None, True))
    for index, frame in enumerate(recording):
        points = world_points(recording, index, frame.depth_m)
        local = trimesh.transform_points(points, np.linalg.inv(truth.world_from_object))
        inside_box = (np.abs(local - mesh.bounds.mean(axis=0)) < mesh.extents / 2 - 1e-3).all(axis=1)
        assert inside_box.sum() > 100
        surface = RayCaster([Part(name="mug", mesh=mesh, world_from_part=np.eye(4))])
        assert surface.clearance_m(local[inside_box]).max() < 1e-4


def test_a_table_holds_its_objects(table: SyntheticRecording) -> None:
    """Five of them, some stacked, each seen in its place in the first frame."""
    assert len(table.truth.objects) == 5
    assert any(one.parent != TABLE for one in table.truth.objects)
    plane = table.truth.support_plane
    assert plane is not None
    view = table.ideal_view(0)
    points = world_points(table, 0, view.depth_m)
    for index, one in enumerate(table.truth.objects):
        seen = points[(view.part == index).ravel()]
        assert len(seen) > 0
        local = trimesh.transform_points(seen, np.linalg.inv(one.world_from_object))
        mesh = trimesh.Trimesh(one.vertices_m, one.faces, process=False)
        assert (np.abs(local - mesh.bounds.mean(axis=0)) <= mesh.extents / 2 + 1e-4).all()
        assert (seen @ plane[:3] + plane[3] > -1e-4).all()


def test_reading_twice_gives_the_same_frames() -> None:
    """Depth, colour and stamps; another seed gives others."""
    mesh = built_in_object("box")
    scene = ObjectScene(camera=SMALL, path=SHORT)
    first, second = (film_object("box", mesh, scene, 1) for _ in range(2))

    for one, other in zip([*first, *first], [*second, *first], strict=True):
        assert one.time_ns == other.time_ns
        np.testing.assert_array_equal(one.depth_m, other.depth_m)
        np.testing.assert_array_equal(one.rgb, other.rgb)
    assert not np.array_equal(first.frame(0).depth_m, film_object("box", mesh, scene, 2).frame(0).depth_m)


def test_other_sizes_and_lenses() -> None:
    """The frames and intrinsics are those asked for."""
    camera = CameraConfig(width=90, height=70, fx=100.0, fy=90.0, cx=40.0, cy=30.0)
    recording = film_object("can", built_in_object("can"), ObjectScene(camera=camera, path=SHORT), 1)

    assert recording.frame(0).depth_m.shape == (70, 90)
    assert recording.frame(0).depth_m.dtype == np.float32
    assert recording.intrinsics == camera.intrinsics
    assert recording.intrinsics.fy == 90.0


def test_repeated_shapes_have_names_of_their_own() -> None:
    """Instances are numbered."""
    scene = TableScene(camera=SMALL, path=SHORT, room=RoomConfig(kind="none"), objects=3)
    recording = film_table({"can": built_in_object("can")}, scene, 0)

    assert sorted(one.name for one in recording.truth.objects) == ["can", "can 2", "can 3"]
    assert {one.shape for one in recording.truth.objects} == {"can"}


def world_points(recording: SyntheticRecording, index: int, depth_m: np.ndarray) -> np.ndarray:
    """World points (H W, 3) of a depth image by an independent formula; far away without a return."""
    lens = recording.intrinsics
    v, u = np.indices(depth_m.shape)
    depth = np.where((depth_m > 0) & np.isfinite(depth_m), depth_m, 100.0).astype(np.float64)
    camera = np.stack([(u - lens.cx) * depth / lens.fx, (v - lens.cy) * depth / lens.fy, depth], axis=-1)
    return trimesh.transform_points(camera.reshape(-1, 3), recording.trajectory.reference_from_camera[index])


def test_colours_are_those_of_names_or_of_films() -> None:
    """Plain and painted objects look alike in every film; random colours do not, in the same scene."""

    def colours(kind: Literal["plain", "painted", "random"], seed: int) -> NDArray[np.float32]:
        scene = ObjectScene(path=PathConfig(frames=1), room=RoomConfig(kind="none"), colours=kind)
        view = film_object("can", built_in_object("can"), scene, seed).ideal_view(0)
        return np.unique(view.rgb[view.part == 0].round(), axis=0)

    assert np.array_equal(colours("plain", 1), [shape_colour("can")])
    assert np.array_equal(colours("plain", 1), colours("plain", 2))
    assert len(colours("painted", 1)) > 1
    assert not np.array_equal(colours("random", 1), colours("random", 2))
