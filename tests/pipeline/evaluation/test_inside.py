"""What lies inside a mesh with holes, against the mesh without them."""

import numpy as np
import pytest
import trimesh

from pipeline.errors import PipelineError
from pipeline.evaluation.inside import lies_inside, winding_numbers


def test_winding_numbers_count_surfaces_around_a_point(seed: int) -> None:
    """1 inside a ball, 0 outside, 2 inside two of them, whatever the triangles."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    double = np.concatenate([ball.triangles, 2 * ball.triangles])
    points = np.random.default_rng(seed).uniform(-2.5, 2.5, (400, 3))
    radius = np.linalg.norm(points, axis=1)
    clear = (np.abs(radius - 1) > 0.05) & (np.abs(radius - 2) > 0.05)

    found = winding_numbers(double, points[clear])

    np.testing.assert_allclose(found, (radius[clear] < 1) * 1.0 + (radius[clear] < 2), atol=1e-9)


def test_a_mesh_with_a_hole_holds_what_it_held_without(seed: int) -> None:
    """An open can, whose bottom is gone: the rays that leave by it do not decide."""
    can = trimesh.creation.cylinder(radius=0.03, height=0.1, sections=64)
    open_ = can.submesh([can.face_normals[:, 2] > -0.5], append=True)
    points = np.random.default_rng(seed).uniform(-0.06, 0.06, (2000, 3))
    hole = np.array([0, 0, -0.05])
    away = np.linalg.norm(points - hole, axis=1) > 0.035

    assert isinstance(open_, trimesh.Trimesh)
    assert not open_.is_watertight
    assert lies_inside(can, points).sum() > 100
    np.testing.assert_array_equal(lies_inside(open_, points)[away], lies_inside(can, points)[away])


def test_a_mesh_of_which_nothing_says_what_is_inside_is_refused() -> None:
    """Holes and flipped faces at once: one line."""
    box = trimesh.creation.box()
    box.faces[:3] = box.faces[:3, ::-1]
    torn = trimesh.Trimesh(box.vertices, box.faces[1:], process=False)
    with pytest.raises(PipelineError, match="wound both ways"):
        lies_inside(torn, np.zeros((1, 3)))
