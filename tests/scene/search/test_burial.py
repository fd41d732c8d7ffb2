"""What reaches below the table is improbable, by how far it does."""

import numpy as np
import pytest
import trimesh

from scene.objects.scene_object import scene_object
from scene.observation.detection import SupportPlane
from scene.search.support_prior import log_not_buried
from shapes.geometry.poses import poses_of

SIGMA_M = 0.02
HALF_M = np.array([0.03, 0.05, 0.07])
TABLE = SupportPlane(
    camera_from_table=np.array([[1, 0, 0, 0.02], [0, -0.8, -0.6, 0.1], [0, 0.6, -0.8, 0.9], [0, 0, 0, 1.0]]),
    half_size_m=np.array([0.4, 0.3]),
    bend=np.zeros(6),
)


@pytest.mark.parametrize(
    ("x_m", "below_m", "deepest_m"), [(0.0, -0.05, 0), (0.0, 0.02, 0.02), (0.0, 0.1, 0.1), (0.6, 0.1, 0)]
)
def test_a_box_pays_for_its_deepest_point_below_the_table(
    x_m: float, below_m: float, deepest_m: float
) -> None:
    """Half a Gaussian of the depth, to the spacing of its points; none over the table, beside or without."""
    mesh = trimesh.creation.box(2 * HALF_M)
    box = scene_object("box", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    table_from_box = np.eye(4)
    table_from_box[:3, 3] = [x_m, 0.0, HALF_M[2] - below_m]
    poses = poses_of(TABLE.camera_from_table @ table_from_box)[None, None]

    log_prior = log_not_buried(TABLE, [box], poses, SIGMA_M)

    assert log_prior.shape == (1, 1)
    assert np.sqrt(-2 * log_prior[0, 0]) * SIGMA_M == pytest.approx(deepest_m, abs=0.002)
    assert log_not_buried(None, [box], poses, SIGMA_M) == 0
