"""Objects rest without overlap and without tipping over, and the truth says on what."""

from collections.abc import Mapping

import numpy as np
import open3d as o3d
import pytest
import trimesh

from pipeline.errors import PipelineError
from pipeline.synthesis.objects import built_in_names, built_in_object
from pipeline.synthesis.placement import Table, rest_on_table
from pipeline.synthesis.resting import RestingObject, is_balanced, stable_poses
from recordings.truth import TABLE

TOP = Table(height_m=0.7, radius_m=0.4, spread_m=0.12)


@pytest.fixture(scope="module")
def shapes() -> Mapping[str, trimesh.Trimesh]:
    """The built-in objects."""
    return {name: built_in_object(name) for name in built_in_names()}


@pytest.fixture(scope="module")
def piles(shapes: Mapping[str, trimesh.Trimesh]) -> list[list[RestingObject]]:
    """Tables of five objects, a third of them stacked."""
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        names = [str(name) for name in rng.choice(built_in_names(), 5, replace=False)]
        found.append(rest_on_table([(name, shapes[name]) for name in names], TOP, rng, stacked_share=1 / 3))
    return found


def test_no_object_sinks_into_another_or_into_the_table(piles: list[list[RestingObject]]) -> None:
    """Surface points of each lie at most half a millimetre inside any other."""
    for pile in piles:
        for one in pile:
            points = surface_points(one)
            assert points[:, 2].min() > TOP.height_m - 1e-6
            for other in pile:
                if other is not one:
                    assert signed_distance_m(other, points).min() > -5e-4


def test_each_touches_its_parent_and_a_third_is_stacked(piles: list[list[RestingObject]]) -> None:
    """The least distance to the parent is under half a millimetre."""
    for pile in piles:
        standing = {one.name: one for one in pile}
        assert sum(one.parent != TABLE for one in pile) >= len(pile) / 3
        for one in pile:
            if one.parent == TABLE:
                assert abs(one.vertices_m[:, 2].min() - TOP.height_m) < 1e-6
            else:
                assert signed_distance_m(standing[one.parent], surface_points(one)).min() < 5e-4


def test_flush_faces_are_level_and_meet(piles: list[list[RestingObject]]) -> None:
    """The named faces of both bounding boxes lie at the height of the contact."""
    checked = 0
    for pile in piles:
        standing = {one.name: one for one in pile}
        for one in pile:
            if one.contact_faces is None:
                continue
            theirs, own = one.contact_faces
            bottom = face_height_m(one, own)
            top = TOP.height_m if one.parent == TABLE else face_height_m(standing[one.parent], theirs)
            assert abs(bottom - top) < 0.01
            checked += 1
    assert checked >= 10


def test_a_box_with_its_centre_beyond_the_edge_tips_over() -> None:
    """Balance looks at the whole load: a counterweight may hold what would fall alone."""
    box = trimesh.creation.box((0.1, 0.1, 0.02))

    def at(
        name: str, x_m: float, z_m: float, carrier: RestingObject | None, low: float, high: float
    ) -> RestingObject:
        contacts = np.array([(x, y) for x in (low, high) for y in (-0.05, 0.05)])
        pose = trimesh.transformations.translation_matrix((x_m, 0, z_m))
        return RestingObject(
            name=name, shape="", mesh=box, world_from_object=pose, carrier=carrier, contacts_xy_m=contacts
        )

    base = at("base", 0, 0.01, None, -0.05, 0.05)
    near = at("near", 0.04, 0.03, base, -0.01, 0.05)
    over = at("over", 0.06, 0.03, base, 0.01, 0.05)
    assert is_balanced(near, [base])
    assert not is_balanced(over, [base])

    second = at("second", 0.08, 0.05, near, 0.03, 0.09)
    assert not is_balanced(second, [base, near])


def test_stable_poses_of_a_box_are_its_six_sides() -> None:
    """Each turns one side onto the plane; the largest is the likeliest."""
    rotations, probabilities = stable_poses(trimesh.creation.box((0.05, 0.1, 0.2)))

    assert len({tuple(np.round(rotation[2]).astype(int)) for rotation in rotations}) == 6
    assert abs(rotations[probabilities.argmax()][2, 0]) > 0.99


def test_too_many_objects_are_refused(shapes: Mapping[str, trimesh.Trimesh]) -> None:
    """The message names what found no place."""
    with pytest.raises(PipelineError, match="no room for"):
        rest_on_table(
            [("bowl", shapes["bowl"])] * 3,
            Table(height_m=0.7, radius_m=0.1, spread_m=0.02),
            np.random.default_rng(0),
        )


def surface_points(one: RestingObject) -> np.ndarray:
    """The vertices and 3,000 other points (N, 3) of an object's surface in the world."""
    sampled = trimesh.sample.sample_surface(one.mesh, 3_000, seed=1)[0]
    return np.concatenate([one.vertices_m, trimesh.transform_points(sampled, one.world_from_object)])


def signed_distance_m(one: RestingObject, points_m: np.ndarray) -> np.ndarray:
    """Distance of points (N, 3) to an object, negative inside."""
    scene = o3d.t.geometry.RaycastingScene()
    tensor = o3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(one.vertices_m.astype(np.float32)), tensor(one.mesh.faces.astype(np.uint32)))
    return scene.compute_signed_distance(tensor(points_m.astype(np.float32)), nsamples=5).numpy()


def face_height_m(one: RestingObject, face: str) -> float:
    """Height in the world of the centre of a bounding-box face."""
    centre = one.mesh.bounds.mean(axis=0)
    axis = "xyz".index(face[1])
    centre[axis] = one.mesh.bounds[1 if face[0] == "+" else 0, axis]
    return float(trimesh.transform_points(centre[None], one.world_from_object)[0, 2])
